"""Where the server is and how it is called, the same for both clients."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass

import httpx

from cow_service import __version__
from cow_service.client.steps import Send

DEFAULT_URL = "http://127.0.0.1:8000"
STREAM_TIMEOUT_SECONDS = 60.0  # of silence in a stream of events; the server sends something every 15
MAX_SERVER_WAIT_SECONDS = 10  # that the server holds one request for a result; then the job is polled
_KEY = re.compile(r"[\x21-\x7e]+")


@dataclass(frozen=True)
class Endpoint:
    """A server: address, key and timeouts."""

    base_url: str
    api_key: str | None
    timeout: httpx.Timeout

    def server_wait(self, timeout: float | None) -> int:
        """Seconds that the server may hold a request for a result (`Prefer: wait`): well within the read timeout."""
        read = self.timeout.read
        longest = MAX_SERVER_WAIT_SECONDS if read is None else min(MAX_SERVER_WAIT_SECONDS, int(read / 2))
        return longest if timeout is None else min(longest, int(timeout))

    @property
    def stream_timeout(self) -> httpx.Timeout:
        """Timeouts of a stream of events, in which the server may be silent for longer."""
        return httpx.Timeout(
            connect=self.timeout.connect, read=STREAM_TIMEOUT_SECONDS, write=self.timeout.write, pool=self.timeout.pool
        )

    def limited(self, seconds: float | None) -> httpx.Timeout:
        """Timeouts of a request, none of them longer than so many seconds."""
        if seconds is None:
            return self.timeout
        limits = self.timeout.as_dict().items()
        return httpx.Timeout(**{name: seconds if limit is None else min(limit, seconds) for name, limit in limits})

    def headers(self, send: Send) -> dict[str, str]:
        """The headers of a request."""
        headers = {"User-Agent": f"cow-service/{__version__}", "Accept": "application/json, */*", **send.headers}
        if send.media_type is not None:
            headers["Content-Type"] = send.media_type
        if self.api_key is not None:
            headers["Authorization"] = f"Bearer {self.api_key}"
        return headers


def endpoint_of(base_url: str | None, api_key: str | None, timeout: float | httpx.Timeout | None) -> Endpoint:
    """The server of these arguments, else of COW_BASE_URL and COW_API_KEY, else the one on this machine.

    Raises `ValueError` for what is no address, and for what is no key.
    """
    address = (base_url or os.environ.get("COW_BASE_URL") or DEFAULT_URL).rstrip("/")
    if not address.startswith(("http://", "https://")):
        raise ValueError(f"base_url must begin with http:// or https://, got {address!r}")
    try:
        url = httpx.URL(address)
    except httpx.InvalidURL as error:
        raise ValueError(f"base_url {address!r} is no address: {error}") from error
    if not url.host or "%" in url.host or not 0 < (url.port or 80) < 65536 or url.query or url.fragment:
        raise ValueError(f"base_url must be a host, maybe a port and a path, and nothing else, got {address!r}")
    key = (os.environ.get("COW_API_KEY") if api_key is None else api_key) or None  # empty: none, whatever is set
    if key is not None and not _KEY.fullmatch(key):
        raise ValueError("api_key must be printable ASCII without spaces; has a line break been read with it?")
    limit = timeout if isinstance(timeout, httpx.Timeout) else httpx.Timeout(timeout, connect=min(10, timeout or 10))
    return Endpoint(address, key, limit)
