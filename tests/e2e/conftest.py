"""The two buses that the processes of these tests may speak on: the loopback hub, and vcan0."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from tests.e2e.plantsite import HUB, ON_VCAN, VCAN
from tests.forked import ForkedProcess


@pytest.fixture(scope="module", params=[HUB, ON_VCAN])
def bus(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The URL of a bus."""
    with ExitStack() as stack:
        if request.param == HUB:
            log = tmp_path_factory.mktemp("hub") / "hub.log"
            hub = ForkedProcess("hub", ("loopwright.protocol.hub", "--port", "0"), log)
            stack.callback(hub.stop)
            yield hub.wait_ready().split()[1]
        else:
            yield VCAN
