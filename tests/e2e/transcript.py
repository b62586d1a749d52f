"""A transcript: a document whose commands a shell runs, as its reader would type them, and whose answers are real.

The words between the blocks are written by hand. A block whose first line is `# NAME` is a file that the reader saves;
a block of ```console has commands after `$ ` (and `> ` where a line goes on) and below each what it answers. A command
that ends with `&` goes on in the background; its first line is awaited.
"""

from __future__ import annotations

import os
import re
import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Self

from tests.ports import free_port

COLUMNS = 116
_BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_FILE = re.compile(r"# ([\w.-]+\.\w+)\n")
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
_ERROR = re.compile(r"±[\d.e+-]+|below (?=0\.001)")
_STEP = r"(?<=overshoot )[\d.]+\s%, settled in [\d.]+\s(?:s|min)"  # the blank before a unit may be a narrow one
_NOISY = re.compile(rf"{_STEP}|(?<=measured )(?:IAE|overshoot|settling)[^\n]*")
_ID = re.compile(r"\b(?=[a-f]*\d)(?=\d*[a-f])[0-9a-f]{12}\b")
_SAME = (
    (re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(?:\.\d+)?Z"), "2026-01-31T12:00:00.000Z"),
    (re.compile(r"\w{3}, \d\d \w{3} \d{4} \d\d:\d\d:\d\d GMT"), "Sat, 31 Jan 2026 12:00:00 GMT"),
    (re.compile(r"x-request-id: \w+"), "x-request-id: 5e1f0a77"),
    (re.compile(r"\b\d:\d\d:\d\d\b"), "0:00:04"),
    (re.compile(r"\b\d\d:\d\d:\d\d  "), "12:00:00  "),
    (re.compile(r"\b\d+ (?:s|min) ago"), "9 s ago"),
)
"""What differs from run to run, and the form in which every run is shown."""
_BOX = re.compile(r"[\s│┃┏┓┗┛┡┩┳╇┬┴┼├┤┌┐└┘━─┠┨╺╸]+")
_STABLE_IDS = [f"{0x4F0C2A9BE113 * (2 * n + 1) % 2**48:012x}" for n in range(12)]
_PATIENCE_S = 120.0


JUST_ASKED_FOR = ("waiting for its turn since", "under way since")


@dataclass
class Said:
    """A command of a transcript, and the answer that the document shows."""

    command: str
    shown: str


@dataclass
class Block:
    """A block of the document: a file to be saved, or commands."""

    start: int
    end: int
    name: str = ""
    content: str = ""
    said: list[Said] = field(default_factory=list)


def blocks(text: str) -> Iterator[Block]:
    """The files and the commands of a document, in order."""
    for found in _BLOCK.finditer(text):
        body = found.group(2)
        if found.group(1) == "console":
            yield Block(found.start(2), found.end(2), said=list(_commands(body)))
        elif named := _FILE.match(body):
            yield Block(found.start(2), found.end(2), named.group(1), body)


def _commands(body: str) -> Iterator[Said]:
    for part in re.split(r"^\$ ", body, flags=re.MULTILINE)[1:]:
        lines = part.splitlines(keepends=True)
        count = 1
        while count < len(lines) and lines[count].startswith("> "):
            count += 1
        command = "".join([lines[0], *(line[2:] for line in lines[1:count])]).rstrip("\n")
        yield Said(command, "".join(lines[count:]))


def written(said: Said, answer: str) -> str:
    """A command and its answer as the document has them."""
    return "$ " + said.command.replace("\n", "\n> ") + "\n" + answer


def differences(shown: str, answer: str, within: float) -> list[str]:
    """Where two answers differ: in their words, or in numbers by more than that part of them, or more than 0.02 where
    the numbers are measured. Widths of columns, where lines are broken, and standard errors do not count: the last are
    left out where they are small, as is whether a difference of Ms is just below 0.001. So are the figures of one step
    under noise: a step that settles at the edge of its band settles in one minute or in two. A job that has just been
    asked for waits for its turn or is under way.

    within: 0.02 at most where nothing is measured.
    """
    one, other = (
        _BOX.sub(" ", _NOISY.sub("", _ERROR.sub("", text))).strip().replace(*JUST_ASKED_FOR) for text in (shown, answer)
    )
    words, others = (_NUMBER.sub("#", text) for text in (one, other))
    if words != others:
        unlike = (i for i, (a, b) in enumerate(zip(words, others, strict=False)) if a != b)
        at = next(unlike, min(len(words), len(others)))
        return [f"words: {words[max(0, at - 40) : at + 40]!r} is {others[max(0, at - 40) : at + 40]!r}"]
    slack = 0.02 if within > 0.02 else 0.0
    found = []
    for shown_number, number in zip(_NUMBER.finditer(one), _NUMBER.finditer(other), strict=True):
        a, b = (float(each.group()) for each in (shown_number, number))
        if abs(a - b) > max(within * max(abs(a), abs(b)), slack):
            found.append(f"...{one[max(0, shown_number.start() - 40) : shown_number.end()]} is {number.group()}")
    return found


def alike(shown: str, answer: str, within: float) -> bool:
    return not differences(shown, answer, within)


class Shell:
    """A shell in a folder, with `loopwright` and this Python on its path. Ports that the document names are replaced by
    free ones, and what differs from run to run by what the document shows."""

    def __init__(self, folder: Path, ports: tuple[int, ...]) -> None:
        self._folder = folder
        self._ports = {str(port): str(free_port()) for port in ports}
        self._ids: dict[str, str] = {}
        self._background = 0
        environment = {name: value for name, value in os.environ.items() if not name.startswith("LOOPWRIGHT_")}
        environment |= {
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
            "COLUMNS": str(COLUMNS), "PYTHONUNBUFFERED": "1", "MPLCONFIGDIR": str(folder / ".matplotlib"),
            "LC_ALL": "C.UTF-8", "LOOPWRIGHT_URL": f"http://127.0.0.1:{self._ports.get('8080', '8080')}",
        }  # fmt: skip
        self._shell = subprocess.Popen(
            ["bash", "--norc"], cwd=folder, env=environment, text=True, start_new_session=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Ends everything that was begun, the service first: it restores its loop."""
        self._send("kill $(jobs -p | tac) 2>/dev/null; wait; exit")
        try:
            self._shell.wait(60.0)
        finally:
            with suppress(ProcessLookupError):
                os.killpg(self._shell.pid, signal.SIGKILL)
            self._shell.wait()
            for pipe in (self._shell.stdin, self._shell.stdout):
                assert pipe is not None
                pipe.close()

    def save(self, name: str, content: str) -> None:
        (self._folder / name).write_text(self._real(content), encoding="utf-8")

    def run(self, command: str) -> str:
        """What a command answers, in the form of the document."""
        real = self._real(command)
        if real.endswith("&"):
            return self._stable(self._in_background(real))
        end = secrets.token_hex(8)
        self._send(f"{real}\nprintf '\\n%s\\n' {end}")
        answer = ""
        while not answer.endswith(f"{end}\n"):
            line = self._pipe.readline()
            assert line, f"the shell has ended: {answer}"
            answer += line
        return self._stable(answer.removesuffix(f"\n{end}\n"))

    @property
    def _pipe(self) -> IO[str]:
        assert self._shell.stdout is not None
        return self._shell.stdout

    def _send(self, text: str) -> None:
        assert self._shell.stdin is not None
        self._shell.stdin.write(text + "\n")
        self._shell.stdin.flush()

    def _in_background(self, command: str) -> str:
        self._background += 1
        log = self._folder / f".background-{self._background}"
        self._send(f"{command.removesuffix('&')} > {log} 2>&1 &")
        give_up = time.monotonic() + _PATIENCE_S
        while not (log.exists() and "\n" in log.read_text()):
            assert time.monotonic() < give_up, f"{command} says nothing"
            time.sleep(0.02)
        return log.read_text().partition("\n")[0] + "\n"

    def _real(self, text: str) -> str:
        for shown, real in (*self._ports.items(), *((stable, real) for real, stable in self._ids.items())):
            text = re.sub(rf"\b{shown}\b", real, text)
        return text

    def _stable(self, text: str) -> str:
        text = text.replace(f"{self._folder}/", "").replace("\r", "")
        for shown, real in self._ports.items():
            text = re.sub(rf"\b{real}\b", shown, text)
        text = _ID.sub(lambda found: self._ids.setdefault(found.group(), _STABLE_IDS[len(self._ids)]), text)
        for pattern, shown in _SAME:
            text = pattern.sub(shown, text)
        text = "\n".join(line.rstrip() for line in text.splitlines())
        return f"{text}\n" if text else ""
