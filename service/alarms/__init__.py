"""What is abnormal, the same on every screen.

alarm.py       an alarm, and the kinds of alarm with their priority and delays
conditions.py  from what is known of loops, buses, nodes and tests to what is abnormal at this moment. Pure
delays.py      from what is abnormal at each moment to alarms: on-delays, off-delays. Pure
merging.py     the alarms of all gateways of a database as one list. Pure
facts.py       gathers what is known, from the listening, the running jobs and the database
watch.py       looks once a second, and takes acknowledgements
"""
