"""The folder of a batch: the outcome of each question, so that a batch that was killed can be resumed.

    batch.json      what is asked of each question, and the secret that its idempotency keys are derived from
    results.jsonl   one line for each question that is done, appended when it is
    retried.jsonl   failures that were asked again

A line is written at once and whole. A line that a kill cut short is removed at the next start; its question is then
sent again under the same key, and the server, which has kept the job, returns its result.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import secrets
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

from cow_service.client.questions import Question
from cow_service.client.serialization import to_json
from cow_service.errors import InvalidRequest
from cow_service.records import JobKind

VERSION = 1


class Journal:
    """One batch's folder, held by one process at a time. Safe to use from every thread."""

    def __init__(self, folder: Path, kind: JobKind, *, retry_failed: bool = False) -> None:
        """Opens the folder, which is made if missing.

        Raises `InvalidRequest` where another process holds it, or where it is that of another kind of batch.
        """
        from filelock import FileLock, Timeout  # noqa: PLC0415 - whoever only calls a server need not have it

        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        self.results = folder / "results.jsonl"
        self._retried = folder / "retried.jsonl"
        self._lock = FileLock(folder / ".lock", thread_local=False)
        self._write_lock = threading.Lock()
        try:
            self._lock.acquire(timeout=0)
        except Timeout as error:
            raise InvalidRequest(
                f"'{folder}' is in use by another batch: wait for it, or use another folder."
            ) from error
        try:
            self._secret = self._begin(kind)
            _cut(self.results)
            _cut(self._retried)
            self._attempts = {line["id"]: line["attempt"] for line in _lines(self._retried)}
            if retry_failed:
                self._set_failures_aside()
            self.done: dict[str, tuple[str, str]] = {
                line["id"]: (line["fingerprint"], line["status"]) for line in _lines(self.results)
            }
            self._file = os.open(self.results, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        except BaseException:
            self._lock.release()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Releases the folder."""
        with self._write_lock:
            if self._file >= 0:
                os.close(self._file)
                self._file = -1
        self._lock.release()

    def has(self, question: Question) -> bool:
        """Whether its outcome is here. Raises `InvalidRequest` where that is one of another question of the same id."""
        known = self.done.get(question.id)
        if known is not None and known[0] != question.fingerprint:
            raise InvalidRequest(
                f"'{self.folder}' has the outcome of another question with the id '{question.id}': what it asks, or "
                "what all are asked, has changed. Use another folder, or another id."
            )
        return known is not None

    def key(self, question: Question, content: bytes, *, fresh: bool = False) -> str:
        """The idempotency key of a question: the same until it fails and is asked again."""
        attempt = self._attempts.get(question.id, 0)
        parts = (self._secret, question.id, str(attempt), str(fresh), hashlib.sha256(content).hexdigest())
        return hashlib.sha256("\0".join(parts).encode()).hexdigest()

    def append(self, question: Question, line: dict[str, Any]) -> None:
        """Keeps an outcome: in one write, so that no two lines mix."""
        whole = {
            "id": question.id,
            **line,
            "meta": question.meta,
            "attempt": self._attempts.get(question.id, 0),
            "fingerprint": question.fingerprint,
        }
        data = to_json(whole) + b"\n"
        with self._write_lock:
            if self._file < 0:
                return  # the batch has ended; the server keeps this result
            end = os.fstat(self._file).st_size
            try:
                while data:
                    data = data[os.write(self._file, data) :]
            except OSError:
                os.ftruncate(self._file, end)  # half a line would spoil the next one
                raise
            self.done[question.id] = (question.fingerprint, line["status"])

    def lines(self) -> Iterator[dict[str, Any]]:
        """All outcomes that are here, in the order in which they came."""
        return _lines(self.results)

    def _begin(self, kind: JobKind) -> str:
        path = self.folder / "batch.json"
        with contextlib.suppress(FileNotFoundError):
            known = _parsed(path)
            try:
                version, known_kind, secret = known["version"], known["kind"], str(known["secret"])
            except (KeyError, TypeError) as error:
                raise InvalidRequest(f"'{path}' is not that of a batch: use another folder.") from error
            if version != VERSION or known_kind != kind:
                raise InvalidRequest(
                    f"'{self.folder}' is the folder of a batch of kind '{known_kind}' (version {version}): "
                    "use another folder."
                )
            return secret
        secret = secrets.token_hex(16)
        _replace(path, json.dumps({"version": VERSION, "kind": kind, "secret": secret}, indent=2).encode() + b"\n")
        return secret

    def _set_failures_aside(self) -> None:
        """Moves failures to `retried.jsonl`. Killed in between, they stand in both, and are moved at the next start."""
        beside = self.results.with_name(self.results.name + ".new")
        failed = 0
        with contextlib.suppress(FileNotFoundError):
            with self.results.open("rb") as lines, beside.open("wb") as kept, self._retried.open("ab") as retried:
                for number, text in enumerate(lines, 1):
                    line = _line(self.results, number, text)
                    if line["status"] != "failed":
                        kept.write(text)
                        continue
                    failed += 1
                    self._attempts[line["id"]] = line["attempt"] + 1
                    retried.write(to_json({**line, "attempt": line["attempt"] + 1}) + b"\n")
                for file in (retried, kept):
                    file.flush()
                    os.fsync(file.fileno())
            if failed:
                beside.replace(self.results)
            else:
                beside.unlink()


def _cut(path: Path) -> None:
    """Cuts off a last line that was not written to its end."""
    with contextlib.suppress(FileNotFoundError), path.open("r+b") as file:
        file.truncate(sum(len(line) for line in file if line.endswith(b"\n")))


def _lines(path: Path) -> Iterator[dict[str, Any]]:
    with contextlib.suppress(FileNotFoundError), path.open("rb") as file:
        for number, line in enumerate(file, 1):
            if not line.endswith(b"\n"):
                return
            yield _line(path, number, line)


def _line(path: Path, number: int, text: bytes) -> dict[str, Any]:
    try:
        line = json.loads(text)
        if not {"id", "status", "attempt", "fingerprint"} <= line.keys():
            raise ValueError
    except (ValueError, AttributeError) as error:
        raise InvalidRequest(
            f"'{path}' is damaged in line {number}: take that line out; its question is then asked again."
        ) from error
    return line


def _parsed(path: Path) -> Any:
    try:
        return json.loads(path.read_bytes())
    except ValueError:
        return None


def _replace(path: Path, data: bytes) -> None:
    beside = path.with_name(path.name + ".new")
    with beside.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    beside.replace(path)
