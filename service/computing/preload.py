"""What the fork server loads before it forks: imported there, so that no computation has to wait for it."""

import os

# Before numpy is loaded: a computation takes one processor, and a process with threads should not be forked.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import gc

import tuning.fast.procedure
import tuning.five_stage  # noqa: F401

gc.freeze()  # what is here stays, and stays shared: no collection writes to it
