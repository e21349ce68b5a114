"""An S3 server: moto's, in a thread of this process, with a bucket. It counts what it is asked."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import httpx
import obstore
from moto.server import ThreadedMotoServer
from obstore.store import S3Store
from waiting import TIME_LIMIT


@dataclass
class ObjectStore:
    """`url` is for COW_ARTIFACTS, `environment` for obstore."""

    server: ThreadedMotoServer
    endpoint: str
    bucket: str
    requests: Counter[str] = field(default_factory=Counter[str])

    @property
    def url(self) -> str:
        return f"s3://{self.bucket}/cow"

    @property
    def environment(self) -> dict[str, str]:
        return {
            "AWS_ACCESS_KEY_ID": "testing",
            "AWS_SECRET_ACCESS_KEY": "testing-secret",
            "AWS_REGION": "us-east-1",
            "AWS_ENDPOINT_URL": self.endpoint,
        }

    def damage(self, sha256: str, media_type: str = "image/png") -> None:
        """Puts other bytes where those of a digest are."""
        obstore.put(self._objects, sha256, b"damaged", attributes={"Content-Type": media_type})

    def remove(self, sha256: str) -> None:
        obstore.delete(self._objects, sha256)

    def names(self) -> set[str]:
        """The names of the objects below the prefix."""
        return {one["path"] for chunk in obstore.list(self._objects) for one in chunk}

    def stop(self) -> None:
        """Is away until `start`."""
        self.server.stop()

    def start(self) -> None:
        """Is back at the same address, with all objects."""
        host, _, port = self.endpoint.removeprefix("http://").partition(":")
        self.server = ThreadedMotoServer(ip_address=host, port=int(port), verbose=True)
        self.server.start()

    def refuse_everybody(self) -> None:
        """From now on keys are looked at, and there is none."""
        assert httpx.post(f"{self.endpoint}/moto-api/reset-auth", content=b"0", timeout=TIME_LIMIT).status_code == 200

    def accept_everybody(self) -> None:
        httpx.post(f"{self.endpoint}/moto-api/reset-auth", content=b"inf", timeout=TIME_LIMIT)

    @property
    def _objects(self) -> S3Store:
        environment = self.environment
        return S3Store(
            self.bucket,
            prefix="cow",
            access_key_id=environment["AWS_ACCESS_KEY_ID"],
            secret_access_key=environment["AWS_SECRET_ACCESS_KEY"],
            region=environment["AWS_REGION"],
            endpoint=self.endpoint,
            client_options={"allow_http": True},
        )


class _Counting(logging.Handler):
    """Werkzeug logs a line for each request: `127.0.0.1 - - [date] "PUT /bucket/name HTTP/1.1" 200 -`."""

    def __init__(self, requests: Counter[str]) -> None:
        super().__init__()
        self._requests = requests

    def emit(self, record: logging.LogRecord) -> None:
        said = record.getMessage().partition('"')[2]
        if said:
            self._requests[said.split()[0]] += 1


@contextmanager
def serving(bucket: str = "bucket") -> Iterator[ObjectStore]:
    """A server with an empty bucket."""
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=True)
    logger = logging.getLogger("werkzeug")
    level = logger.level
    server.start()
    host, port = server.get_host_and_port()
    store = ObjectStore(server, f"http://{host}:{port}", bucket)
    counting = _Counting(store.requests)
    try:
        logger.addHandler(counting)
        logger.setLevel(logging.INFO)
        httpx.post(f"{store.endpoint}/moto-api/reset", timeout=TIME_LIMIT).raise_for_status()
        httpx.put(f"{store.endpoint}/{bucket}", timeout=TIME_LIMIT).raise_for_status()
        store.requests.clear()
        yield store
    finally:
        logger.removeHandler(counting)
        logger.setLevel(level)
        store.server.stop()
