"""Where the server is and how it is called, the same for both clients."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass

import httpx

from cow_service import __version__
from cow_service.client.calls import PATIENCE, Send

DEFAULT_URL = "http://127.0.0.1:8000"
DEFAULT_TIMEOUT = 60.0  # seconds without a word from the server
SILENCE = 60.0  # seconds in a stream of events; the server says something every 15
RETRIES = 5
FIRST_TRIES = 3  # connections to a server that has never answered
_KEY = re.compile(r"[\x21-\x7e]+")


class Contact:
    """Whether a server has ever answered: one that has not is soon said to be missing, and not waited for."""

    def __init__(self) -> None:
        self._answered = False
        self._refused = 0

    def missing(self, came: httpx.Response | httpx.HTTPError) -> bool:
        """Whether this was one refused connection too many, with no answer before."""
        self._answered = self._answered or isinstance(came, httpx.Response)
        self._refused += isinstance(came, httpx.ConnectError)
        return not self._answered and self._refused >= FIRST_TRIES


@dataclass(frozen=True)
class Target:
    """A server, by address and key."""

    base_url: str
    api_key: str | None
    timeout: httpx.Timeout

    def patience(self, timeout: float | None) -> int:
        """Seconds that one request waits for a job: well within the time after which silence counts as broken."""
        longest = PATIENCE if self.timeout.read is None else min(PATIENCE, int(self.timeout.read / 2))
        return longest if timeout is None else min(longest, int(timeout))

    @property
    def following(self) -> httpx.Timeout:
        """Limits of a stream of events, in which the server may be silent for longer."""
        return httpx.Timeout(
            connect=self.timeout.connect, read=SILENCE, write=self.timeout.write, pool=self.timeout.pool
        )

    def limited(self, seconds: float | None) -> httpx.Timeout:
        """Limits of a request, none of them longer than so many seconds."""
        own = self.timeout
        if seconds is None:
            return own
        connect, read, write, pool = (seconds if one is None else min(one, seconds) for one in _parts(own))
        return httpx.Timeout(connect=connect, read=read, write=write, pool=pool)

    def url(self, path: str) -> str:
        """The address of a path of the API."""
        return self.base_url + path

    def headers(self, send: Send) -> dict[str, str]:
        """The headers of a request."""
        headers = {"User-Agent": f"cow-service/{__version__}", "Accept": "application/json, */*", **send.headers}
        if send.media_type is not None:
            headers["Content-Type"] = send.media_type
        if self.api_key is not None:
            headers["Authorization"] = f"Bearer {self.api_key}"
        return headers


def _parts(timeout: httpx.Timeout) -> tuple[float | None, float | None, float | None, float | None]:
    return timeout.connect, timeout.read, timeout.write, timeout.pool


def target_of(base_url: str | None, api_key: str | None, timeout: float | httpx.Timeout | None) -> Target:
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
    return Target(address, key, limit)
