"""The steps that operations consist of, without the I/O.

An operation (`operations.py`) is a generator: it yields the next step and is sent the step's result. `Connection` and
`AsyncConnection` perform the steps, so that both clients behave the same. An exception that ends a step, such as an
interrupt or a cancellation, is thrown into the generator.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias, TypeVar

T = TypeVar("T")


@dataclass(frozen=True)
class Send:
    """Send a request; the result is an `httpx.Response` or an `httpx.HTTPError`.

    `limit` caps the client's timeout, in seconds of silence. `follow` goes where a redirect points, which is another
    host where the server keeps artifacts in an object store: httpx sends it no API key.
    """

    method: str
    path: str
    headers: Mapping[str, str] = field(default_factory=dict[str, str])
    params: Mapping[str, Any] = field(default_factory=dict[str, Any])
    content: bytes | None = None
    media_type: str | None = None
    limit: float | None = None
    follow: bool = False


@dataclass(frozen=True)
class Sleep:
    """Wait."""

    seconds: float


@dataclass(frozen=True)
class Blocking:
    """Call a function that blocks; the result is what it returns. An event loop runs it in a thread."""

    function: Callable[[], Any]


@dataclass(frozen=True)
class Shielded:
    """Run further steps to their end, even if the caller is canceled meanwhile."""

    steps: Steps[None]


Step: TypeAlias = Send | Sleep | Blocking | Shielded
Steps: TypeAlias = Generator[Step, Any, T]


class Stopped(BaseException):
    """The steps are not wanted any more: the batch that performs them in a thread has ended."""


def finished(steps: Steps[T]) -> T:
    """The result of steps none of which needs performing."""
    try:
        next(steps)
    except StopIteration as end:
        return end.value
    raise RuntimeError("these steps need a connection")
