"""What the documents name is there: files, folders, links, modules, make targets, commands."""

from __future__ import annotations

import re
import subprocess
from importlib.util import find_spec
from pathlib import Path

import pytest
import typer.main

from loopwright.service.cli.main import app
from loopwright.tuning.reasons import ADVICE

ROOT = Path(__file__).parents[3]
FILES = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
DATED = "CHANGELOG.md"
"""It tells of the time in which it was written."""
DOCUMENTS = [name for name in FILES if name.endswith(".md") and name != DATED]
OF_THE_READER = {"plant.json", "loops.yaml", "/openapi.json"}
TARGETS = set(re.findall(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)[0].split())
COMMANDS = set(typer.main.get_command(app).commands)  # type: ignore[attr-defined]


def text(document: str) -> str:
    return (ROOT / document).read_text(encoding="utf-8")


@pytest.mark.parametrize("document", DOCUMENTS)
def test_files_and_folders_that_it_names_are_there(document: str) -> None:
    named = set(re.findall(r"`([\w./-]+\.(?:py|md|yml|yaml|toml|json|eds|c))`", text(document))) - OF_THE_READER
    folders = set(re.findall(r"`([\w-]+(?:/[\w-]+)*/)`", text(document)))
    below = {f"/{name}" for name in FILES}
    assert not {name for name in named if not any(each.endswith(f"/{name}") for each in below)}
    assert not {name for name in folders if not any(f"/{name}" in each for each in below)}


def test_the_advice_of_each_reason_is_that_of_the_code() -> None:
    rows = {f"| `{reason.value}` | {advice} |" for reason, advice in ADVICE.items()}
    assert rows - set(text("docs/safety.md").splitlines()) == set()


@pytest.mark.parametrize("document", DOCUMENTS)
def test_links_lead_somewhere(document: str) -> None:
    links = re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", text(document))
    assert not {link for link in links if not (ROOT / document).parent.joinpath(link).exists()}


@pytest.mark.parametrize("document", DOCUMENTS)
def test_modules_that_it_names_are_there(document: str) -> None:
    named = set(re.findall(r"(?:-m |from |import |`)(loopwright(?:\.\w+)*)", text(document))) - {"loopwright.sqlite"}
    assert not {name for name in named if not found(name)}
    assert not re.findall(r"`(?:tuning|service|protocol|controller|plantsim)\.\w+", text(document)), "not whole"


def found(name: str) -> bool:
    """A module, or a name in one."""
    try:
        return find_spec(name) is not None
    except ModuleNotFoundError:
        return find_spec(name.rpartition(".")[0]) is not None


@pytest.mark.parametrize("document", DOCUMENTS)
def test_commands_that_it_names_are_there(document: str) -> None:
    assert set(re.findall(r"`make ([\w-]+)", text(document))) <= TARGETS
    commands = re.findall(r"(?:`|^    |/bin/)loopwright ([a-z][\w-]*)", text(document), re.MULTILINE)
    assert set(commands) <= COMMANDS


EXAMPLES = [
    pytest.param(code, printed, id=f"{document}-{number}")
    for document in DOCUMENTS
    for number, (code, printed) in enumerate(
        re.findall(r"^```python\n(.*?)^```\n\n```\n(.*?)^```$", text(document), re.MULTILINE | re.DOTALL)
    )
]


@pytest.mark.parametrize(("code", "printed"), EXAMPLES)
def test_examples_print_what_is_printed_below_them(code: str, printed: str, capsys: pytest.CaptureFixture[str]) -> None:
    exec(compile(code, "example", "exec"), {})
    assert capsys.readouterr().out == printed
