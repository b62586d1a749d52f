"""The controller process of a version before the order WATCH: python -m tests.e2e.older_controller ARGS"""

from __future__ import annotations

import sys
from typing import Any
from unittest.mock import patch

from loopwright.controller import __main__ as process
from loopwright.controller.device import ControllerDevice
from loopwright.protocol.objects import lookup
from loopwright.protocol.profile import Order
from loopwright.protocol.session import STAGED, object_of


class OlderDevice(ControllerDevice):
    def __init__(self, *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        for name in (object_of(Order.WATCH), *STAGED[Order.WATCH]):
            del self.dictionary.by_index[lookup(name).index]


if __name__ == "__main__":
    with patch.object(process, "ControllerDevice", OlderDevice):
        sys.exit(process.main())
