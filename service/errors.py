"""Wishes that cannot be met now, whoever asks and however."""

from __future__ import annotations


class UnknownLoop(Exception):
    """No loop of that tag is configured."""

    def __init__(self, tag: str) -> None:
        super().__init__(f"there is no loop {tag}")
        self.tag = tag


class Stopping(Exception):
    """The service is shutting down and takes no new work."""


class Conflict(Exception):
    """The job or its loop is not as the wish supposes."""
