"""The modules that the fork server imports before it forks, so that no computation has to wait for an import."""

import gc
import os
from importlib import import_module

LOADED = (
    "loopwright.service.jobs.alternatives",
    "loopwright.service.jobs.job_figures",
    "loopwright.service.api.report.paper",
    "loopwright.service.cli.main",  # the script `loopwright` imports it, and each process imports what the script does
    "loopwright.service.execution.excursions",
    "loopwright.service.execution.rehearsals",
    "loopwright.service.execution.rehearsal",
    "loopwright.service.observing.observed",
    "loopwright.service.offline.tunings",
    "loopwright.tuning.fast.relay.procedure",
    "loopwright.tuning.fast.known_plant.design_trial",
    "loopwright.tuning.five_stage.procedure",
)

gc.disable()  # while modules are loaded next to nothing becomes garbage
# Set before numpy is imported: a computation uses one processor, and a process with threads should not be forked.
os.environ["OPENBLAS_NUM_THREADS"] = "1"
for name in LOADED:
    import_module(name)
gc.enable()
gc.freeze()  # the objects loaded so far stay shared, because no collection writes to them
