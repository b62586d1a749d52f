"""What every test with the `canopen` library needs."""

from __future__ import annotations

import pytest
from canopen.sdo.client import WritableStream


@pytest.fixture(autouse=True)
def no_request_by_the_garbage_collector(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keeps `canopen` from a deadlock. The stream of a refused segmented download sends its last segment when it is
    collected: where that happens while another request is being sent, the thread waits for a lock that it holds itself
    (Network.send_lock), for ever."""
    monkeypatch.setattr(WritableStream, "__del__", lambda stream: None, raising=False)
