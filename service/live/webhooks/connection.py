"""One HTTP request to a webhook: to an address that was checked, within a time, without following a redirect.

A name is resolved once, and the connection made to one of the addresses that were found and are permitted: a name that
leads elsewhere a moment later changes nothing.
"""

from __future__ import annotations

import socket
import ssl
import time
from collections.abc import Iterable, Mapping
from ipaddress import ip_address
from typing import Any

import httpcore

from loopwright.service.inputs.public_addresses import is_public

TIMEOUT_S = 10.0
"""Wall time for the whole request, s."""


class NotDelivered(Exception):
    """The request was not answered; the text says why, without the path of the address."""


def post(url: str, headers: Mapping[str, str], body: bytes, allow_private: bool, timeout_s: float = TIMEOUT_S) -> int:
    """Posts a body; returns the status of the answer, whose own body is not read. Raises NotDelivered."""
    checked = CheckedAddresses(allow_private, time.monotonic() + timeout_s)
    try:
        with (
            httpcore.ConnectionPool(ssl_context=_authorities(url), network_backend=checked, max_connections=1) as pool,
            pool.stream("POST", url, headers=list(headers.items()), content=body) as answer,
        ):
            return int(answer.status)
    except NotDelivered:
        raise
    except httpcore.TimeoutException:
        raise NotDelivered(f"no answer within {timeout_s:g} s") from None
    except (httpcore.NetworkError, httpcore.ProtocolError, OSError) as error:
        raise NotDelivered(str(error) or type(error).__name__) from None


def _authorities(url: str) -> ssl.SSLContext | None:
    """The authorities that this machine trusts, a company's own among them; SSL_CERT_FILE names others."""
    return ssl.create_default_context() if url.startswith("https:") else None


class CheckedAddresses(httpcore.NetworkBackend):
    """Connects to permitted addresses alone. deadline: when every wait ends, time.monotonic()."""

    def __init__(self, allow_private: bool, deadline: float) -> None:
        self._allow_private, self._deadline = allow_private, deadline
        self._sync = httpcore.SyncBackend()

    def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,
        socket_options: Iterable[Any] | None = None,
    ) -> httpcore.NetworkStream:
        failed: Exception = NotDelivered(f"{host} has no address")
        for address in self._permitted(host, port):
            try:
                stream = self._sync.connect_tcp(address, port, _left(self._deadline), local_address, socket_options)
                return _Timed(stream, self._deadline)
            except httpcore.ConnectError as error:
                failed = error
        raise failed

    def _permitted(self, host: str, port: int) -> list[str]:
        try:
            found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        except (OSError, UnicodeError) as error:
            raise NotDelivered(f"{host} cannot be resolved: {error}") from None
        addresses = list(dict.fromkeys(str(each[4][0]) for each in found))
        permitted = [each for each in addresses if self._allow_private or is_public(ip_address(each.partition("%")[0]))]
        if addresses and not permitted:
            raise NotDelivered(
                f"{host} leads to {', '.join(addresses)}, which is not public: allow_private: true permits it"
            )
        return permitted


class _Timed(httpcore.NetworkStream):
    """A stream all of whose waits end at one time: a server that sends a byte now and then does not hold it."""

    def __init__(self, stream: httpcore.NetworkStream, deadline: float) -> None:
        self._stream, self._deadline = stream, deadline

    def read(self, max_bytes: int, timeout: float | None = None) -> bytes:
        return self._stream.read(max_bytes, _left(self._deadline))

    def write(self, buffer: bytes, timeout: float | None = None) -> None:
        self._stream.write(buffer, _left(self._deadline))

    def close(self) -> None:
        self._stream.close()

    def start_tls(
        self, ssl_context: ssl.SSLContext, server_hostname: str | None = None, timeout: float | None = None
    ) -> httpcore.NetworkStream:
        return _Timed(self._stream.start_tls(ssl_context, server_hostname, _left(self._deadline)), self._deadline)

    def get_extra_info(self, info: str) -> Any:
        return self._stream.get_extra_info(info)


def _left(deadline: float) -> float:
    left = deadline - time.monotonic()
    if left <= 0.0:
        raise httpcore.ReadTimeout("the time is over")
    return left
