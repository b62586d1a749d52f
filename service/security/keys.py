"""API keys: what they look like, how they are kept, and what each scope permits.

A key is `lw_ID_SECRET`: the id names the row, the secret (256 random bits) is shown once and kept as its scrypt hash.
The fixed beginning lets a log filter, or a scanner of repositories, recognise a key.
"""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
from enum import StrEnum

KEY_PATTERN = re.compile(r"lw_([0-9a-f]{12})_([A-Za-z0-9_-]{43})")
# 16 MiB and some 50 ms for each guess; the secret is random, so this is a second wall, not the first.
_SCRYPT = {"n": 2**14, "r": 8, "p": 1}
_HASH = re.compile(r"scrypt\$(\d+)\$(\d+)\$(\d+)\$([0-9a-f]+)\$([0-9a-f]+)")


class Scope(StrEnum):
    """Each includes those before it."""

    READ = "read"
    OPERATE = "operate"
    ADMIN = "admin"

    def includes(self, other: Scope) -> bool:
        order = list(Scope)
        return order.index(self) >= order.index(other)


def new_key() -> tuple[str, str]:
    """(id, the whole key)."""
    key_id = secrets.token_hex(6)
    return key_id, f"lw_{key_id}_{secrets.token_urlsafe(32)}"


def key_id_of(key: str) -> str | None:
    """The id in a key; None when it is not one of ours."""
    match = KEY_PATTERN.fullmatch(key)
    return match[1] if match else None


def hash_key(key: str) -> str:
    """What is kept: algorithm, its three costs, salt and hash, so that the costs can grow later."""
    salt = secrets.token_bytes(16)
    costs = "$".join(str(_SCRYPT[name]) for name in ("n", "r", "p"))
    return f"scrypt${costs}${salt.hex()}${_scrypt(key, salt, **_SCRYPT).hex()}"


def matches(key: str, kept: str) -> bool:
    """Whether the key is the one that was kept. Some 50 ms."""
    parts = _HASH.fullmatch(kept)
    if parts is None:
        return False
    n, r, p = (int(parts[i]) for i in (1, 2, 3))
    return hmac.compare_digest(_scrypt(key, bytes.fromhex(parts[4]), n=n, r=r, p=p), bytes.fromhex(parts[5]))


def _scrypt(key: str, salt: bytes, *, n: int, r: int, p: int) -> bytes:
    return hashlib.scrypt(key.encode(), salt=salt, n=n, r=r, p=p, maxmem=256 * n * r, dklen=32)
