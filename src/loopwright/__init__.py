"""Retunes PI/PID loops by itself, over CANopen, and ends safe whatever fails.

`loopwright.tuning` is the library: models, rules, margins, procedures; `loopwright.rehearsal` retunes a plant of your
own in memory. The other packages are the processes that work on loops: `service`, `controller`, `plantsim`, and the
`protocol` that they speak.
"""
