"""A plant of the user's own in a Python file, FILE.py:NAME, for `loopwright rehearse`."""

from __future__ import annotations

import importlib.util
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from loopwright.service.cli.output import die

if TYPE_CHECKING:
    from loopwright.service.execution.rehearsed import Rehearsal
    from loopwright.tuning.plan import Event


def plant_of(given: str) -> Any:
    """Returns the object with step(mv) that FILE.py:NAME names, made by NAME() where that is a class or a function;
    None for what names no Python file. Ends the command with status 2 where there is none."""
    path, colon, name = given.rpartition(":") if ".py:" in given else (given, "", "")
    if not path.endswith(".py"):
        return None
    file = Path(path)
    if not file.is_file():
        die(f"{path}: there is no such file", 2)
    spec = importlib.util.spec_from_file_location(file.stem, file)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.path.insert(0, str(file.resolve().parent))
    sys.modules[file.stem] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        die(f"{path} cannot be used: {_in_words(error, file)}", 2)
    if not colon or not hasattr(module, name):
        plants = [known for known, each in vars(module).items() if callable(getattr(each, "step", None))]
        there = f"; it has {', '.join(plants)}" if plants else ", an object with step(mv)"
        die(f"{path}: name the plant, {path}:NAME{there}", 2)
    plant = getattr(module, name)
    if isinstance(plant, type) or not hasattr(plant, "step"):
        if not callable(plant):
            die(f"{given} is no plant: give an object with step(mv), or what makes one", 2)
        try:
            plant = plant()
        except Exception as error:
            die(f"{given}() made no plant: {_in_words(error, file)}", 2)
    return plant


def retuned(
    given: str, plant: Any, method: str, on_event: Callable[[Event], None] | None, options: dict[str, Any]
) -> Rehearsal:
    """Returns how the rehearsal ended; ends the command with status 2 where the plant cannot be used."""
    from loopwright.service.execution.own_plant import retune
    from loopwright.tuning.reasons import Refused

    try:
        return retune(plant, method, on_event=on_event, **options)
    except Refused as refused:
        die(f"{given}: {refused.detail}", 2)
    except Exception as error:
        die(f"{given}: {_in_words(error, Path(given.rpartition(':')[0]))}", 2)


def _in_words(error: Exception, file: Path) -> str:
    """The error with its notes, and the last line of the file that it went through."""
    lines = [
        frame.lineno for frame in traceback.extract_tb(error.__traceback__) if Path(frame.filename).name == file.name
    ]
    if isinstance(error, SyntaxError) and error.lineno is not None:
        lines = [error.lineno]
    said = f"{error.msg}" if isinstance(error, SyntaxError) else f"{error}"
    where = f" (line {lines[-1]})" if lines else ""
    return "; ".join([f"{type(error).__name__}: {said}{where}", *getattr(error, "__notes__", ())])
