"""A rehearsal as `loopwright rehearse --json` prints it."""

from __future__ import annotations

from typing import Any

from loopwright.service.execution import rehearsal


def rehearse(*given: Any, **options: Any) -> dict[str, Any]:
    return rehearsal.rehearse(*given, **options).as_json()
