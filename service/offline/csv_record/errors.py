"""What is wrong with a file, each kind of error counted once, with the first lines that have it."""

from __future__ import annotations

from collections.abc import Sequence

from loopwright.service.inputs.validation import listed

MAX_PROBLEMS = 20
SHOWN_LINES = 5


class RecordError(Exception):
    """The file cannot be used; `problems` has a line for each kind of error (the first 20)."""

    def __init__(self, source: str, problems: Sequence[str]) -> None:
        shown = list(problems[:MAX_PROBLEMS])
        if len(problems) > MAX_PROBLEMS:
            shown.append(f"and {len(problems) - MAX_PROBLEMS} more")
        super().__init__(listed(source, len(problems), shown))
        self.problems = shown


class Unusable(Exception):
    """What was read cannot be used; `problems` says why, without the name of the file."""

    def __init__(self, *problems: str) -> None:
        super().__init__("; ".join(problems))
        self.problems = problems


def counted(lines: Sequence[int], one: str, many: str) -> str:
    """Returns an error with its lines: `one` for a single line, else their number, `many` and the first five lines."""
    if len(lines) == 1:
        return f"line {lines[0]}: {one}"
    shown = ", ".join(map(str, lines[:SHOWN_LINES]))
    return f"{len(lines)} {many}, {'first ' if len(lines) > SHOWN_LINES else ''}in lines {shown}"


def number_of(count: int, one: str, many: str) -> str:
    """Returns a number with the word for it: "1 line", "2 lines"."""
    return f"{count} {one if count == 1 else many}"
