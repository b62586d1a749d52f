"""The names in the packages are the field's words, and each class name names one thing."""

from __future__ import annotations

import io
import json
import re
import tokenize
from collections import defaultdict
from collections.abc import Iterator

import pytest
import typer

from loopwright.protocol import profile
from loopwright.service.api.report import words as report_words
from loopwright.service.cli.main import app
from loopwright.tuning import plan
from tests.unit.tools.test_documents import DOCUMENTS, FILES, ROOT, text

PACKAGES = ("containers", "controller", "plantsim", "protocol", "service", "tuning")
FORBIDDEN = {
    "story": "disturbance hypothesis",
    "stories": "disturbance hypotheses, candidates",
    "teller": "candidate",
    "surprise": "model mismatch",
    "judged": "evaluated",
    "earned": "minimum gain of BIC",
}
"""Words of the first version that are in no name of any package, each with the field's word."""
FORBIDDEN_IN_TUNING = FORBIDDEN | {
    "wish": "specification",
    "wishes": "specification",
    "heed": "request stop",
    "quiet": "undisturbed",
    "moving": "not at rest initially",
    "told": "disturbed, reported",
    "swing": "input range",
    "span": "output range",
    "reach": "maximum step",
    "colour": "Durbin-Watson ratio, variance inflation: three formulas bore this name",
    "least": "minimum",
    "most": "maximum",
    "cause": "reason",
    "verdict": "evaluation, assessment",
    "worth": "performance",
}
EXTERNAL = {"least_squares"}
"""Names of other libraries."""
KEPT = {
    ("tuning/experiments/step_test.py", "mv_span"),  # a key of stored results
    ("tuning/fast/evaluation/proposal.py", "span"),  # a key of stored results
    ("tuning/fast/relay/relay_test.py", "span"),
    ("tuning/analysis/comparison.py", "verdict"),  # a key of stored results
    ("tuning/operation/recorded_operation.py", "verdict"),
}
OLD_NAMES = {
    "after_beside", "after_curves", "agreeing", "before_curves", "careful", "chosen", "device_went_back", "disarmed",
    "dismiss", "dismissed", "gains_after", "gains_before", "gateway_silent", "going_on", "heard", "host", "J_after",
    "J_before", "last_heard", "level", "look_after", "ms", "not_confirmed_home", "not_heard", "old_gains",
    "older_plant", "predicted_before", "put_back", "requested_by", "retunes", "roll_back_by_itself", "said_by",
    "sign-off", "signed_off", "to_sign", "tried", "when_silent", "who", "why_not",
}  # fmt: skip
"""Names in JSON, paths and commands that the field calls otherwise."""
OLD_WORDS = re.compile(
    r"[Ss]ign(?:s|ed|ing)?[ -]off|\bsigns? (?:it|this|the alarm) off|\b[Aa]bnormal|No result to trust|At rest\?"
    r"|Whole record|First PI|decision waits|tuned already|needs a look|made good|may grow|[Ss]ettled within"
    r"|not explained|where it pays|goes home|looked after|put back by itself|No word from|not heard|\b[Oo]ld gains"
    r"|Who signs|>Signed |never tried"
)
"""Words of the page and of the terminal that the field says otherwise."""
SAME_THING_TWICE = {"Mode"}
"""The controller's mode: `tuning` must not import `protocol`, so both have the enumeration."""


def modules(*packages: str) -> list[str]:
    return [name for name in FILES if name.endswith(".py") and name.startswith(tuple(f"{p}/" for p in packages))]


def names(module: str) -> Iterator[tuple[int, str]]:
    """The identifiers of a module with their lines."""
    for token in tokenize.generate_tokens(io.StringIO((ROOT / module).read_text(encoding="utf-8")).readline):
        if token.type == tokenize.NAME:
            yield token.start[0], token.string


def words(name: str) -> set[str]:
    """The words that a name is made of, in lower case: those of `MAX_TIME` and of `MaxTime` are max and time."""
    return {word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)}


@pytest.mark.parametrize(("name", "expected"), [
    ("MAX_MISMATCH_OF_A_STORY", {"max", "mismatch", "of", "a", "story"}), ("LoadStep", {"load", "step"}),
    ("_quiet", {"quiet"}), ("almost", {"almost"}), ("IAE_r", {"iae", "r"}),
])  # fmt: skip
def test_a_name_is_split_into_its_words(name: str, expected: set[str]) -> None:
    assert words(name) == expected


@pytest.mark.parametrize("package", PACKAGES)
def test_no_name_has_a_word_that_is_not_the_fields(package: str) -> None:
    forbidden = FORBIDDEN_IN_TUNING if package == "tuning" else FORBIDDEN
    found = [
        f"{module}:{line}: {name} ({forbidden[word]})"
        for module in modules(package)
        for line, name in names(module)
        for word in words(name) & forbidden.keys()
        if (module, name) not in KEPT and name not in EXTERNAL
    ]
    assert not found


def test_every_exception_is_needed() -> None:
    assert not {(module, name) for module, name in KEPT if name not in {found for _, found in names(module)}}


def test_each_class_name_names_one_thing() -> None:
    where = defaultdict(list)
    for module in modules(*PACKAGES):
        for name in re.findall(r"^class (\w+)", (ROOT / module).read_text(encoding="utf-8"), re.MULTILINE):
            where[name].append(module)
    assert {name for name, defined in where.items() if len(defined) > 1} == SAME_THING_TWICE
    assert {mode.name: mode.value for mode in plan.Mode} == {mode.name: mode.value for mode in profile.Mode}


def test_page_and_report_have_one_name_for_each_stage_and_reason() -> None:
    page = (ROOT / "service/api/web/static/js/words.js").read_text(encoding="utf-8")
    tables = dict(re.findall(r"^const (STAGES|REASONS) = \{\n(.*?)^\};", page, re.MULTILINE | re.DOTALL))
    stages = dict(re.findall(r'^  (\w+): \["(.*?)",', tables["STAGES"], re.MULTILINE))
    reasons = dict(re.findall(r'^  (\w+): "(.*?)",', tables["REASONS"], re.MULTILINE))
    assert stages == report_words.STAGES
    assert reasons == {reason.value: said for reason, said in report_words.REASONS.items()}


def texts(node: object) -> Iterator[str]:
    """The descriptions and summaries of an OpenAPI document."""
    if isinstance(node, dict):
        yield from (value for name, value in node.items() if name in ("description", "summary") and type(value) is str)
        for each in node.values():
            yield from texts(each)
    elif isinstance(node, list):
        for each in node:
            yield from texts(each)


def named(node: object) -> Iterator[str]:
    """The names of properties, parameters, path segments, and words of closed lists of an OpenAPI document."""
    if isinstance(node, dict):
        yield from node.get("properties", {})
        yield from (each for each in node.get("enum", []) if isinstance(each, str))
        if "in" in node and isinstance(node.get("name"), str):
            yield node["name"]
        for path in node.get("paths", {}):
            yield from path.strip("/").split("/")
        for each in node.values():
            yield from named(each)
    elif isinstance(node, list):
        for each in node:
            yield from named(each)


def test_no_old_name_is_in_the_api() -> None:
    document = json.loads((ROOT / "tests/golden/openapi.json").read_text(encoding="utf-8"))
    assert not OLD_NAMES & {*named(document)}
    assert not [each for each in texts(document) if OLD_WORDS.search(each)]


def test_no_old_word_is_on_the_page_or_in_the_report() -> None:
    shown = [
        name for name in FILES
        if name.startswith(("service/api/web/static/", "service/api/report/")) and "/vendor/" not in name
        and name.endswith((".js", ".html", ".py"))
    ]  # fmt: skip
    assert len(shown) > 40
    found = [
        f"{name}:{number}: {line.strip()[:120]}"
        for name in shown
        for number, line in enumerate((ROOT / name).read_text(encoding="utf-8").splitlines(), 1)
        if OLD_WORDS.search(line) or (name.endswith(".js") and re.search(OLD_MEMBERS, line))
    ]
    assert not found


OLD_MEMBERS = rf"\.(?:{'|'.join(sorted(OLD_NAMES - {'chosen', 'sign-off', 'heard', 'ms'}))})\b"
"""An old name as a member; the others are names of the page's own, too."""


def test_no_old_word_is_in_the_help_or_in_what_is_printed() -> None:
    command = typer.main.get_command(app)
    for name, each in command.commands.items():  # type: ignore[attr-defined]
        help_text = f"{each.help} " + " ".join(f"{getattr(p, 'help', '')} {p.opts}" for p in each.params)
        assert name not in OLD_NAMES and not OLD_WORDS.search(help_text), name
    printed = [
        f"{name}:{token.start[0]}: {token.string}"
        for name in FILES
        if name.startswith("service/cli/") and name.endswith(".py")
        for token in tokenize.generate_tokens(io.StringIO((ROOT / name).read_text(encoding="utf-8")).readline)
        if token.type == tokenize.STRING and OLD_WORDS.search(token.string)
    ]
    assert not printed


@pytest.mark.parametrize("document", DOCUMENTS)
def test_documents_have_the_new_names(document: str) -> None:
    assert not re.findall(r"`surprise`|\bstor(?:y|ies) of\b|\bverdict\.py\b", text(document))
