"""What screens show of all loops, as it happens: one producer for all viewers of this service.

messages.py        the messages of the stream
rows.py            what a message says of a loop, from what was heard and from the jobs. Pure
viewer.py          what one viewer has not taken yet, bounded
jobs.py            the live jobs and their events, as they were looked up last
live.py            the producer, and the stream of a viewer
snapshot.py        what gateways that share a database say of their loops
own_gateway.py     what this one says, and the thread that writes it once a second
other_gateways.py  what the others have said, read once a second for all who ask
"""
