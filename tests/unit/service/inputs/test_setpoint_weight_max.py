"""The largest set-point weight b of gains: loops.yaml permits it, a request lowers it or, where the file says nothing,
chooses it."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from loopwright.service.inputs.config import ConfigError, LoopConfig, parse_site
from loopwright.service.inputs.request import BadLimits, DesignRetune, retune_request, within
from loopwright.tuning.fast.design.design import WEIGHTS

ENTRY = {
    "tag": "TIC-1", "bus": "virtual:x", "controller_node": 0x20, "pv_unit": "degC",
    "pv_limits": {"low": 0.0, "high": 100.0}, "t95_s": 30.0, "sp_deviation": 1.0,
}  # fmt: skip


def loop(**more: Any) -> LoopConfig:
    return parse_site({"loops": [ENTRY | more]}, "test").loops["TIC-1"]


@pytest.mark.parametrize("method", ["fast", "setpoint"])
@pytest.mark.parametrize(
    ("named", "asked", "permitted"),
    [(None, None, None), (None, 1.5, 1.5), (1.5, None, 1.5), (1.5, 0.8, 0.8), (0, 0, 0)],
)
def test_what_is_permitted(method: str, named: float | None, asked: float | None, permitted: float | None) -> None:
    config = loop(**({} if named is None else {"setpoint_weight_max": named}))
    request = retune_request(method=method, **({} if asked is None else {"setpoint_weight_max": asked}))
    assert isinstance(request, DesignRetune)
    assert within(config, request).setpoint_weight_max == permitted
    assert request.options.spec().weights == (WEIGHTS if asked is None else (0.0, asked))


def test_a_request_for_more_than_the_file_permits_is_refused() -> None:
    request = retune_request(setpoint_weight_max=1.5)
    with pytest.raises(BadLimits, match=r"setpoint_weight_max 1\.5 is more than the 1 of loops\.yaml"):
        within(loop(setpoint_weight_max=1.0), request)


@pytest.mark.parametrize("value", [-0.1, 2.1, float("nan")])
def test_it_is_from_0_to_2(value: float) -> None:
    with pytest.raises(ConfigError, match="setpoint_weight_max"):
        loop(setpoint_weight_max=value)
    with pytest.raises(ValidationError):
        retune_request(setpoint_weight_max=value)


def test_it_is_no_option_of_the_five_stages() -> None:
    with pytest.raises(ValidationError, match='setpoint_weight_max: of "method": "fast"'):
        retune_request(method="five-stage", setpoint_weight_max=1.5)
