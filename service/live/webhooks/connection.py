"""One HTTP request to a webhook, which follows no redirect."""

from __future__ import annotations

import ssl
from collections.abc import Mapping

import httpx

TIMEOUT_S = 10.0
"""Wall time for the connection, and for each piece of the answer, s."""


class NotDelivered(Exception):
    """The request was not answered; the text says why, without the path of the address."""


def post(url: str, headers: Mapping[str, str], body: bytes, timeout_s: float = TIMEOUT_S) -> int:
    """Posts a body; returns the status of the answer, whose own body is not read. Raises NotDelivered."""
    # The authorities that this machine trusts, a company's own among them; SSL_CERT_FILE names others.
    authorities = ssl.create_default_context() if url.startswith("https:") else False
    try:
        with (
            httpx.Client(verify=authorities, timeout=timeout_s, trust_env=False) as client,
            client.stream("POST", url, headers=dict(headers), content=body) as answer,
        ):
            return answer.status_code
    except httpx.TimeoutException:
        raise NotDelivered(f"no answer within {timeout_s:g} s") from None
    except httpx.HTTPError as error:
        raise NotDelivered(str(error) or type(error).__name__) from None
