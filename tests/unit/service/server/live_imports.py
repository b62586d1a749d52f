"""Loads what the service loads, carries out one job of each method, and prints what was imported before and
meanwhile.

    python -m tests.unit.service.server.live_imports FOLDER
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType

from loopwright.service.execution.procedures import rehearse, tune
from loopwright.service.inputs.config import parse_site
from loopwright.service.inputs.request import retune_request
from loopwright.service.server import serving
from loopwright.service.server.assembly import make_jobs
from loopwright.service.store.store import Store


class Watch:
    """Notes, while it is entered, every module that is looked for because it is not loaded."""

    def __init__(self) -> None:
        self._seen: list[str] = []

    def __enter__(self) -> list[str]:
        sys.meta_path.insert(0, self)
        return self._seen

    def __exit__(self, *_: object) -> None:
        sys.meta_path.remove(self)

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        self._seen.append(name)
        return None


METHODS = ("fast", "setpoint", "five-stage")


def main(folder: Path) -> None:
    serving.load()
    loaded = sorted(sys.modules)
    from benchmarks.rehearsed import entry, open_loop
    from tests.unit.service.fakes import ThreadEngine

    known = set(loaded)
    # what the loop in memory has loaded, and not the service, is not there for the jobs
    for name in [name for name in sys.modules if name.startswith("loopwright.") and name not in known]:
        del sys.modules[name]
    found = {}
    for method in METHODS:
        store, engine = Store(folder / method), ThreadEngine()
        loops = parse_site({"loops": [entry("A")]}, "live imports").loops
        jobs = make_jobs(loops, store, open_loop, tune, rehearse, engine=engine)
        jobs.boot()
        with Watch() as seen:
            job = jobs.start("A", retune_request(method=method))
            engine.join(100)
            jobs.stop()
        found[method] = [store.get(job.id).state, *seen]
        store.close()
    print(json.dumps({"loaded": loaded, "seen": found}))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
