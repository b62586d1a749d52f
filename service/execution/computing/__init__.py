"""Long computations in processes of their own: the interpreter of the service is for the bus and the requests.

limits.py      what one computation may take
child.py       what runs in the process of a computation
preload.py     what every such process finds loaded
pool.py        whose turn it is, and what becomes of a computation that ends otherwise
"""
