"""The names in the packages are the field's words, and each class name names one thing."""

from __future__ import annotations

import io
import re
import tokenize
from collections import defaultdict
from collections.abc import Iterator

import pytest

from loopwright.protocol import profile
from loopwright.service.api.report import words as report_words
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
    ("tuning/fast/proposal.py", "span"),  # a key of stored results
    ("tuning/fast/relay_test.py", "span"),
    ("tuning/analysis/comparison.py", "verdict"),  # a key of stored results
    ("tuning/operation/recorded_operation.py", "verdict"),
}
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


@pytest.mark.parametrize("document", DOCUMENTS)
def test_documents_have_the_new_names(document: str) -> None:
    assert not re.findall(r"`surprise`|\bstor(?:y|ies) of\b|\bverdict\.py\b", text(document))
