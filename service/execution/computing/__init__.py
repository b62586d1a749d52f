"""Long computations in processes of their own, so that the service's interpreter is free for the bus and the requests.

limits.py      limits of one computation
child.py       the program of a computation's process
preload.py     modules that every such process finds loaded
pool.py        the order of the computations, and the handling of failed ones
"""
