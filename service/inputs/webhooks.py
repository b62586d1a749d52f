"""The webhooks of loops.yaml: where the service says of itself that a job awaits a decision, or has ended."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Iterable
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Self
from urllib.parse import SplitResult, urlsplit

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

_SECRET_BYTES = range(24, 65)
"""Lengths that Standard Webhooks permits for a secret."""
_PREFIX = "whsec_"


class WebhookEvent(StrEnum):
    """What a webhook is called for; the value is the `type` of its body."""

    NEEDS_DECISION = "job.needs_decision"
    ENDED = "job.ended"


class WebhookConfig(BaseModel):
    """A webhook.

    secret_file: a file with the secret that both sides know: base64, perhaps after `whsec_`; relative to loops.yaml.
    allow_http: whether the address may begin with http.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]
    url: Annotated[str, Field(max_length=2000)]
    secret_file: str = Field(min_length=1)
    events: tuple[WebhookEvent, ...] = Field(default=tuple(WebhookEvent), min_length=1)
    allow_http: bool = False

    @field_validator("url")
    @classmethod
    def _an_address(cls, value: str) -> str:
        parts = _split(value)
        if parts is None or parts.scheme not in ("http", "https") or not parts.hostname:
            raise ValueError("an address of the form https://HOST/PATH is expected")
        if parts.username is not None or parts.password is not None:
            raise ValueError("the address must hold no name and no password: deliveries are signed with the secret")
        return value

    @model_validator(mode="after")
    def _permitted(self) -> Self:
        parts = urlsplit(self.url)
        if parts.scheme == "http" and not self.allow_http:
            raise ValueError("url begins with http, which anybody on the way can read: use https, or allow_http: true")
        return self

    @property
    def origin(self) -> str:
        """Scheme, host and port: what may be shown, as the path of a webhook is often a secret."""
        parts = urlsplit(self.url)
        return f"{parts.scheme}://{parts.netloc}"


def _split(url: str) -> SplitResult | None:
    if not url.isascii() or any(character.isspace() or not character.isprintable() for character in url):
        return None
    try:
        parts = urlsplit(url)
        return None if parts.port == 0 else parts
    except ValueError:  # of the port too
        return None


class BadSecret(ValueError):
    """The secret of a webhook cannot be used; the text says why, without the secret."""


def read_secret(config: WebhookConfig, folder: Path) -> bytes:
    """Returns the secret of a webhook. folder: that of loops.yaml. Raises BadSecret."""
    file = folder / config.secret_file
    try:
        text = file.read_text(encoding="ascii").strip().removeprefix(_PREFIX)
    except OSError as error:
        raise BadSecret(f"webhooks: {config.name}: {file}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise BadSecret(f"webhooks: {config.name}: {file} is not base64: {_MADE_BY}") from None
    try:
        secret = base64.b64decode(text, validate=True)
    except binascii.Error:
        raise BadSecret(f"webhooks: {config.name}: {file} is not base64: {_MADE_BY}") from None
    if len(secret) not in _SECRET_BYTES:
        raise BadSecret(f"webhooks: {config.name}: {file} has {len(secret)} bytes, 24 to 64 are expected: {_MADE_BY}")
    return secret


_MADE_BY = "make it with: openssl rand -base64 32"


def repeated_names(webhooks: Iterable[WebhookConfig]) -> list[str]:
    """Returns the names that several webhooks have."""
    names = [each.name for each in webhooks]
    return sorted({name for name in names if names.count(name) > 1})
