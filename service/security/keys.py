"""API keys: their form, their storage, and what each scope permits.

A key is `lw_ID_SECRET`: the id names the row, the secret (256 random bits) is shown once and stored as its scrypt hash.
By the fixed prefix a log filter, or a scanner of repositories, recognises a key.
"""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
from enum import StrEnum

KEY_PATTERN = re.compile(r"lw_([0-9a-f]{12})_([A-Za-z0-9_-]{43})")
# 16 MiB and about 50 ms for each guess; the secret is random, so this is only an additional protection.
_SCRYPT = {"n": 2**14, "r": 8, "p": 1}
_HASH = re.compile(r"scrypt\$(\d+)\$(\d+)\$(\d+)\$([0-9a-f]+)\$([0-9a-f]+)")


class Scope(StrEnum):
    """The scopes of a key; each includes those before it."""

    READ = "read"
    OPERATE = "operate"
    ADMIN = "admin"

    def includes(self, other: Scope) -> bool:
        """Returns whether this scope permits what the other one permits."""
        order = list(Scope)
        return order.index(self) >= order.index(other)


def new_key() -> tuple[str, str]:
    """Returns the id of a new key, and the whole key."""
    key_id = secrets.token_hex(6)
    return key_id, f"lw_{key_id}_{secrets.token_urlsafe(32)}"


def key_id_of(key: str) -> str | None:
    """Returns the id in a key; None when the text is not a key of this form."""
    match = KEY_PATTERN.fullmatch(key)
    return match[1] if match else None


def hash_key(key: str) -> str:
    """Returns what is stored: algorithm, its three costs, salt and hash, so that the costs can be raised later."""
    salt = secrets.token_bytes(16)
    costs = "$".join(str(_SCRYPT[name]) for name in ("n", "r", "p"))
    return f"scrypt${costs}${salt.hex()}${_scrypt(key, salt, **_SCRYPT).hex()}"


def matches(key: str, stored: str) -> bool:
    """Returns whether the key belongs to this stored hash. It takes about 50 ms."""
    parts = _HASH.fullmatch(stored)
    if parts is None:
        return False
    n, r, p = (int(parts[i]) for i in (1, 2, 3))
    return hmac.compare_digest(_scrypt(key, bytes.fromhex(parts[4]), n=n, r=r, p=p), bytes.fromhex(parts[5]))


def _scrypt(key: str, salt: bytes, *, n: int, r: int, p: int) -> bytes:
    return hashlib.scrypt(key.encode(), salt=salt, n=n, r=r, p=p, maxmem=256 * n * r, dklen=32)
