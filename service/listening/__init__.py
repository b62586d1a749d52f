"""The process data of every configured loop, heard by a process of its own that sends nothing, and kept as history.

bins.py        rows of the history: samples and bins of samples, merged, thinned, packed
rings.py       the history of one loop in bounded memory
heard_loop.py  from the frames of a loop to its history
child.py       the process that listens
listening.py   the service's side of that process
"""
