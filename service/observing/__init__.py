"""What the history of a loop, which nobody disturbed for it, tells of its gains: no job, no session, nothing written
on the loop.

resolution.py   samples or bins of which length, and how far back they reach
stretches.py    from rows of the history to evenly sampled stretches of normal operation
observed.py     the evaluation of the stretches, and the answer
exported.py     the same from the file of a historian, without a service
hearing.py      what is asked of the history of a loop
neighbours.py   which loops disturb each other
knowledge.py    what is known of a loop: which findings of tests and of operation agree
kept_knowledge.py  the same in the store
"""
