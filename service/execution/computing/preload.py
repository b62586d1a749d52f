"""What the fork server loads before it forks: imported there, so that no computation has to wait for it."""

import gc
import os
from importlib import import_module

LOADED = (
    "scipy.signal",  # tuning imports it when it first needs it
    "loopwright.service.jobs.alternatives",
    "loopwright.service.cli.main",  # the script `loopwright` imports it, and each process imports what the script does
    "loopwright.service.execution.rehearsals",
    "loopwright.service.execution.rehearsal",
    "loopwright.service.offline.tunings",
    "loopwright.tuning.fast.procedure",
    "loopwright.tuning.fast.design_trial",
    "loopwright.tuning.five_stage.procedure",
)

# Before numpy is loaded: a computation takes one processor, and a process with threads should not be forked.
os.environ["OPENBLAS_NUM_THREADS"] = "1"
for name in LOADED:
    import_module(name)
gc.freeze()  # what is here stays, and stays shared: no collection writes to it
