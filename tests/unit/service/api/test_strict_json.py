from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from loopwright.service.api.strict_json import DEEPEST, BadJson, loads

PLAIN = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(10**20), 10**20)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0")),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0")), inner, max_size=4)
    ),
    max_leaves=12,
)


@given(PLAIN)
def test_what_is_json_is_read_as_everywhere(value: object) -> None:
    for text in (json.dumps(value), json.dumps(value, ensure_ascii=False)):
        assert loads(text) == value and loads(text.encode()) == value and loads("\ufeff" + text) == value
    assert loads(b"\xef\xbb\xbf" + json.dumps(value).encode()) == value


@pytest.mark.parametrize(
    "text, where, why",
    [
        ('{"dry_run": true, "dry_run": false}', "dry_run", "given twice"),
        ('{"dry_run": true, "dry_run": true}', "dry_run", "given twice"),
        (r'{"dry_run": true, "dry\u005frun": false}', "dry_run", "given twice"),
        ('{"plant": {"num": [1], "den": [1, 1], "num": [2]}}', "plant.num", "given twice"),
        ('[1, {"a": [0, {"b": 1, "c": 2, "b": 3}]}]', "1.a.1.b", "given twice"),
        ('{"K": NaN}', "K", "are not numbers"),
        ('{"K": [1, -Infinity]}', "K.1", "are not numbers"),
        ('{"K": 1e999}', "K", "beyond 1.8e308"),
        ("1" * 5000, "", "not a number that can be used"),
        (r'{"by": "a\u0000b"}', "by", "character 0"),
        (r'{"by": ["x", "\ud800"]}', "by.1", "surrogate"),
        (r'{"\ud800": 1}', "", "surrogate"),
        ("[" * DEEPEST + "[]" + "]" * DEEPEST, ".".join("0" * DEEPEST), "nested"),
        ("[" * 1_000_000, "", "nested"),
        ('{"a":' * 200_000, "", "nested"),
        ("", "", "not JSON"),
        ("{", "", "not JSON"),
        ("{} {}", "", "not JSON"),
        (b"\xff{}", "", "UTF-8: byte 0"),
        ('{"a": 1}'.encode("utf-16"), "", "UTF-8"),
    ],
)
def test_what_is_refused_and_where(text: str | bytes, where: str, why: str) -> None:
    with pytest.raises(BadJson) as caught:
        loads(text)
    assert caught.value.where == where and why in caught.value.why


def test_as_deep_as_is_permitted() -> None:
    text = "[" * DEEPEST + "]" * DEEPEST
    assert json.loads(text) == loads(text)
