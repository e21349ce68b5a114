"""What a batch asks, and the folder that keeps the outcome of each question, so that a killed batch can be resumed.

    batch.json      the kind of the batch, and the secret that its idempotency keys are derived from
    results.jsonl   one line for each question that is done, appended when it is
    retried.jsonl   failures that were asked again

A line is written at once and whole. A line that a kill cut short is removed at the next start; its question is then
sent again under the same key, and the server, which has kept the job, returns its result.
"""

import contextlib
import hashlib
import json
import os
import re
import secrets
import threading
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

from cow_service.client.request import ImageLike, image_input, is_url, request_fields, to_json
from cow_service.errors import CowError, FieldError, InvalidRequest
from cow_service.records import JobKind

# A mapping has `image` and `question`, maybe `id` and `meta`, and else fields of the request; a pair has the first two.
QuestionLike: TypeAlias = "Question | Mapping[str, Any] | tuple[ImageLike, str]"
MAX_ID_CHARACTERS = 200
_OWN_FIELDS = {"id", "image", "meta", "question"}  # of each question: no defaults are taken for them
_CONVERTED = {"law", "grounding", "objects"}  # fields that are not sent as they are given
_PLAIN = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")


@dataclass(frozen=True)
class Question:
    """One question of a batch. `meta` is anything to keep with its outcome, such as the true answer.

    `named` is what tells its image from others; by default its path, its URL, or the digest of its bytes. No file is
    read for it.
    """

    id: str
    image: ImageLike
    question: str
    options: Mapping[str, Any] = field(default_factory=dict[str, Any])
    meta: Any = None
    named: Any = None

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of the question; for an image in a file its path counts, not its bytes."""
        image, named = self.image, self.named
        if named is None:
            if isinstance(image, Path) or (isinstance(image, str) and not image.lower().startswith("data:")):
                named = str(image)
            elif isinstance(image, Mapping):
                named = dict(image)
            else:
                sent = image_input(image)
                named = hashlib.sha256(sent).hexdigest() if isinstance(sent, bytes) else sent
        asked = {**self.options, "image": named, "question": self.question}
        return hashlib.sha256(to_json(dict(sorted(asked.items())))).hexdigest()

    @property
    def folder(self) -> str:
        """A name for a folder of its own: its id where that is plain, else the digest of it."""
        return self.id if _PLAIN.fullmatch(self.id) else hashlib.sha256(self.id.encode()).hexdigest()[:32]


def questions(
    items: Iterable[QuestionLike], defaults: Mapping[str, Any] | None = None, folder: Path | None = None
) -> Iterator[Question]:
    """The questions of these items, each with an id: its own, else one derived from its content.

    `defaults` are fields of the request for those that do not have them. Files are looked for in `folder`. Raises
    `InvalidRequest` for an item without image or question, for what no JSON can hold, and for an id that comes twice.
    """
    defaults = defaults or {}
    if wrong := sorted(_OWN_FIELDS & defaults.keys()):
        names = " and ".join(f"`{name}`" for name in wrong)
        raise InvalidRequest(f"Each question has its own {names}: give none for all.")
    seen: set[str] = set()
    same: Counter[str] = Counter()
    for place, item in enumerate(items, 1):
        question = _read_item(item, place, defaults, folder)
        try:
            if _CONVERTED & question.options.keys():
                question = replace(question, options=request_fields(question.options))
        except CowError as error:
            raise InvalidRequest(f"Question {place}: {error.detail}", errors=error.errors) from error
        if question.id == "":
            made = question.fingerprint[:16]
            same[made] += 1
            question = replace(question, id=made if same[made] == 1 else f"{made}-{same[made]}")
        if question.id in seen:
            raise _invalid(place, "id", f"'{question.id}' stands before; give each its own")
        seen.add(question.id)
        yield question


def _read_item(item: Any, place: int, defaults: Mapping[str, Any], folder: Path | None) -> Question:
    """A question; without an id unless it has one. Raises `InvalidRequest` if it is not a `QuestionLike`."""
    if isinstance(item, Question):
        question = replace(item, options={**defaults, **item.options}) if defaults else item
    else:
        if not isinstance(item, Mapping) and not (isinstance(item, tuple | list) and len(item) == 2):
            raise InvalidRequest(f"Question {place} is a {type(item).__name__}: give a mapping, or image and question.")
        given: dict[str, Any] = dict(item) if isinstance(item, Mapping) else {"image": item[0], "question": item[1]}
        for name in ("image", "question"):
            if given.get(name) is None:
                raise _invalid(place, name, "is missing")
        if not isinstance(given["question"], str):
            raise _invalid(place, "question", f"must be a text, got {type(given['question']).__name__}")
        own = given.pop("id", None)
        if own is not None and not 0 < len(str(own)) <= MAX_ID_CHARACTERS:
            raise _invalid(place, "id", f"has {len(str(own))} characters; give 1 to {MAX_ID_CHARACTERS}")
        image, text, meta = given.pop("image"), given.pop("question"), given.pop("meta", None)
        named = None
        if folder is not None and isinstance(image, str) and not is_url(image):
            image, named = folder / image, image  # the same question, from wherever the folder is looked at
        question = Question("" if own is None else str(own), image, text, {**defaults, **given}, meta, named)
    # JSON has no objects of other libraries, and no half of a surrogate pair: found before it is asked and paid for.
    for name in ("id", "question", "meta"):
        try:
            to_json(getattr(question, name))
        except (TypeError, ValueError) as error:
            raise _invalid(place, name, f"cannot be written as JSON: {error}") from error
    return question


def _invalid(place: int, name: str, detail: str) -> InvalidRequest:
    message = f"Question {place}: `{name}` {detail}."
    return InvalidRequest(message, errors=(FieldError(f"/{place - 1}/{name}", detail),))


VERSION = 1


class Journal:
    """One batch's folder, held by one process at a time. Safe to use from every thread."""

    def __init__(self, folder: Path, kind: JobKind, *, retry_failed: bool = False) -> None:
        """Opens the folder, which is made if missing.

        Raises `InvalidRequest` if another process holds it, or where it is that of another kind of batch.
        """
        from filelock import FileLock, Timeout  # noqa: PLC0415 - not needed to call a server

        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        self.results = folder / "results.jsonl"
        self._retried = folder / "retried.jsonl"
        self._lock = FileLock(folder / ".lock", thread_local=False)
        self._write_lock = threading.Lock()
        try:
            self._lock.acquire(timeout=0)
        except Timeout as error:
            raise InvalidRequest(f"'{folder}' is in use by another batch: wait, or use another folder.") from error
        try:
            self._secret = self._begin(kind)
            for path in (self.results, self._retried):  # cuts off a last line that was not written to its end
                with contextlib.suppress(FileNotFoundError), path.open("r+b") as file:
                    file.truncate(sum(len(line) for line in file if line.endswith(b"\n")))
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

    def close(self) -> None:
        """Releases the folder."""
        with self._write_lock:
            if self._file >= 0:
                os.close(self._file)
                self._file = -1
        self._lock.release()

    def has(self, question: Question) -> bool:
        """Whether its outcome is here. Raises `InvalidRequest` if that is one of another question of the same id."""
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
        """The secret of the batch, which is made where the folder is new."""
        path = self.folder / "batch.json"
        if not path.exists():
            made = {"version": VERSION, "kind": kind, "secret": secrets.token_hex(16)}
            beside = path.with_name(path.name + ".new")
            with beside.open("wb") as file:
                file.write(json.dumps(made, indent=2).encode() + b"\n")
                _flush(file)
            beside.replace(path)
        try:
            known = json.loads(path.read_bytes())
            version, known_kind, secret = known["version"], known["kind"], str(known["secret"])
        except (KeyError, TypeError, ValueError) as error:
            raise InvalidRequest(f"'{path}' is not that of a batch: use another folder.") from error
        if version != VERSION or known_kind != kind:
            raise InvalidRequest(
                f"'{self.folder}' is the folder of a batch of kind '{known_kind}' (version {version}): "
                "use another folder."
            )
        return secret

    def _set_failures_aside(self) -> None:
        """Moves failures to `retried.jsonl`. Killed in between, they stand in both, and are moved at the next start."""
        failed = [line for line in _lines(self.results) if line["status"] == "failed"]
        if not failed:
            return
        with self._retried.open("ab") as retried:
            for line in failed:
                self._attempts[line["id"]] = line["attempt"] + 1
                retried.write(to_json({**line, "attempt": line["attempt"] + 1}) + b"\n")
            _flush(retried)
        beside = self.results.with_name(self.results.name + ".new")
        with self.results.open("rb") as texts, beside.open("wb") as kept:
            lines = zip(texts, _lines(self.results), strict=True)
            kept.writelines(text for text, line in lines if line["status"] != "failed")
            _flush(kept)
        beside.replace(self.results)


def _flush(file: BinaryIO) -> None:
    file.flush()
    os.fsync(file.fileno())


def _lines(path: Path) -> Iterator[dict[str, Any]]:
    """The completely written lines. Raises `InvalidRequest` for one that does not belong to a batch."""
    with contextlib.suppress(FileNotFoundError), path.open("rb") as file:
        for number, text in enumerate(file, 1):
            if not text.endswith(b"\n"):
                return
            try:
                line = json.loads(text)
                if not {"id", "status", "attempt", "fingerprint"} <= line.keys():
                    raise ValueError
            except (ValueError, AttributeError) as error:
                raise InvalidRequest(
                    f"'{path}' is damaged in line {number}: take that line out; its question is then asked again."
                ) from error
            yield line
