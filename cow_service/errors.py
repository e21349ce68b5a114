"""Every error that a caller can get.

    CowError
    ├── InvalidRequest             invalid-request          422
    │   └── MalformedBody          malformed-body           400
    ├── NotFound                   not-found                404
    ├── MethodNotAllowed           method-not-allowed       405
    ├── Unauthorized               unauthorized             401
    ├── OriginNotAllowed           origin-not-allowed       403
    ├── RateLimited                rate-limited             429
    ├── ArtifactNotFound           artifact-not-found       404
    ├── RangeNotSatisfiable        range-not-satisfiable    416
    ├── BodyTooLarge               body-too-large           413
    ├── BodyTooSlow                body-too-slow            408
    ├── BodyTypeUnsupported        body-type-unsupported    415
    ├── ImageTooLarge              image-too-large          413
    ├── ImageUnreadable            image-unreadable         422
    ├── ImageTypeUnsupported       image-type-unsupported   415
    ├── ImageUrlNotAllowed         image-url-not-allowed    422
    ├── ImageUrlUnreachable        image-url-unreachable    422
    ├── CannotGround               cannot-ground            422
    │   └── ObjectNotFound         object-not-found         422
    ├── CannotReadDirection        cannot-read-direction    422
    ├── ReaderUnavailable          reader-unavailable       503
    ├── PerceptionUnavailable      perception-unavailable   503
    │   └── PerceptionMissing      perception-missing       501
    ├── MllmBadReply               mllm-bad-reply           502
    ├── MllmRefused                mllm-refused             422
    ├── MllmUnavailable            mllm-unavailable         503
    ├── GeneratorUnavailable       generator-unavailable    503
    │   ├── WeightsUnavailable     weights-unavailable      503
    │   └── CheckpointInvalid      checkpoint-invalid       503
    ├── GeneratorOutOfMemory       generator-out-of-memory  503
    ├── DeviceFailed               device-failed            503
    ├── ModelNotFound              model-not-found          404
    ├── JobNotFound                job-not-found            404
    ├── DownloadUnavailable        download-unavailable     409
    ├── IdempotencyKeyReused       idempotency-key-reused   422
    ├── WebhookNotAllowed          webhook-not-allowed      422
    ├── QueueFull                  queue-full               503
    ├── NotReady                   not-ready                503
    ├── ShuttingDown               shutting-down            503
    ├── Canceled                   canceled                 409
    ├── StorageUnavailable         storage-unavailable      503
    ├── WorkerEnded                worker-ended             500
    ├── JobTimeout                 job-timeout              504
    └── InternalError              internal-error           500

An error's docstring is its title in the response. Its message says what was wrong, with the value, and how to fix it;
it never holds a path, a trace or a secret. The SDK raises the same classes for the same codes.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution
from typing import Any

TYPE_PREFIX = "urn:cow:problem:"  # a problem's type is this and its code: a name, not an address
MAX_DETAIL = 2000  # characters
MAX_FIELDS = 50  # of one error
SHOWN_CHARACTERS = 80  # of what the caller sent


@dataclass(frozen=True)
class FieldError:
    """One invalid field of a request: a JSON Pointer (RFC 6901) and what is wrong there."""

    pointer: str
    detail: str


def pointer_part(part: int | str) -> str:
    """One step of a JSON Pointer, escaped (RFC 6901); a key of more than `SHOWN_CHARACTERS` is cut."""
    return shortened(str(part)).replace("~", "~0").replace("/", "~1")


def field_of(pointer: str) -> str:
    """A JSON Pointer as messages name a field: `objects.0.mask` for /objects/0/mask."""
    return pointer[1:].replace("/", ".")


def shortened(text: str, most: int = SHOWN_CHARACTERS) -> str:
    """The text, cut after `most` characters with its full length noted: callers may send megabytes."""
    return text if len(text) <= most else f"{text[:most]}... ({len(text)} characters)"


def listed(names: Sequence[str], most: int = 8, joint: str = ", ") -> str:
    """The first `most` names, and how many more there are; for messages."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return joint.join(names[:most]) + more


class CowError(Exception):
    """Something went wrong."""

    code: str = "internal-error"
    status: int = 500
    request_id: str | None = None  # of the response that carried it, if any

    def __init_subclass__(cls, *, code: str | None = None, status: int | None = None, **others: Any) -> None:
        super().__init_subclass__(**others)
        cls.code, cls.status = code or cls.code, status or cls.status

    def __init__(
        self,
        detail: str,
        *,
        remedy: str = "",
        errors: tuple[FieldError, ...] = (),
        headers: dict[str, str] | None = None,
    ) -> None:
        self.detail = shortened(detail, MAX_DETAIL)
        self.remedy = remedy  # for HTTP callers; CLI, page and MCP may replace it with their own
        super().__init__(f"{self.detail} {remedy}".rstrip())
        self.errors = errors[:MAX_FIELDS]
        self.headers = headers or {}  # of the HTTP response
        self.usage: dict[str, Any] | None = None  # calls of a multimodal LLM before the failure, if any
        self.refusal: dict[str, Any] | None = None  # by the multimodal LLM's server: a `records.MllmRefusal`

    @property
    def title(self) -> str:
        """The kind of error in one sentence, the same for every occurrence."""
        return (type(self).__doc__ or "").strip()

    def as_problem(self) -> dict[str, Any]:
        """The members of an RFC 9457 problem, as `records.Problem` has them."""
        problem = {
            "type": TYPE_PREFIX + self.code,
            "title": self.title,
            "status": self.status,
            "detail": self.detail,
            "errors": [asdict(field) for field in self.errors],
        }
        others = {"remedy": self.remedy or None, "usage": self.usage, "refusal": self.refusal}
        return problem | {name: value for name, value in others.items() if value is not None}


class InvalidRequest(CowError, code="invalid-request", status=422):
    """The request is not valid."""


def wrong(pointer: str, detail: str) -> InvalidRequest:
    """The error for one field, by its JSON Pointer."""
    return InvalidRequest(f"{pointer or 'The body'}: {detail}.", errors=(FieldError(pointer, detail),))


class MalformedBody(InvalidRequest, code="malformed-body", status=400):
    """The body could not be read."""


class NotFound(CowError, code="not-found", status=404):
    """Nothing is served at this address."""


class MethodNotAllowed(CowError, code="method-not-allowed", status=405):
    """This address does not support that HTTP method."""


class Unauthorized(CowError, code="unauthorized", status=401):
    """The request has no valid API key."""


class OriginNotAllowed(CowError, code="origin-not-allowed", status=403):
    """Web pages from that origin may not use the server."""


class RateLimited(CowError, code="rate-limited", status=429):
    """Too many requests came in too short a time."""


class ArtifactNotFound(CowError, code="artifact-not-found", status=404):
    """No artifact has that digest."""


class RangeNotSatisfiable(CowError, code="range-not-satisfiable", status=416):
    """The range lies outside the artifact."""


class BodyTooLarge(CowError, code="body-too-large", status=413):
    """The body is larger than the server allows."""


class BodyTooSlow(CowError, code="body-too-slow", status=408):
    """The body did not arrive in time."""


class BodyTypeUnsupported(CowError, code="body-type-unsupported", status=415):
    """The server does not accept bodies of that media type."""


class ImageTooLarge(CowError, code="image-too-large", status=413):
    """The image has more pixels than the server allows."""


class ImageUnreadable(CowError, code="image-unreadable", status=422):
    """The image could not be decoded."""


class ImageTypeUnsupported(CowError, code="image-type-unsupported", status=415):
    """The image is not PNG, JPEG or WebP."""


class ImageUrlNotAllowed(CowError, code="image-url-not-allowed", status=422):
    """The server may not fetch images from that URL."""


class ImageUrlUnreachable(CowError, code="image-url-unreachable", status=422):
    """The image could not be fetched from its URL."""


class CannotGround(CowError, code="cannot-ground", status=422):
    """An object in the question could not be found in the image, or does not allow what the question says."""


class ObjectNotFound(CannotGround, code="object-not-found"):
    """The multimodal LLM did not see the object in the image."""


class CannotReadDirection(CowError, code="cannot-read-direction", status=422):
    """The direction of the motion could not be determined."""


class ReaderUnavailable(CowError, code="reader-unavailable", status=503):
    """The reader, the part that understands the question, cannot run on this server."""


class PerceptionUnavailable(CowError, code="perception-unavailable", status=503):
    """A vision model of the server cannot run: it is missing, damaged, or does not fit into memory."""


class PerceptionMissing(PerceptionUnavailable, code="perception-missing", status=501):
    """The server lacks a vision model for this: none is chosen, or its packages are not installed."""


class MllmBadReply(CowError, code="mllm-bad-reply", status=502):
    """The multimodal LLM gave no usable reply."""


class MllmRefused(CowError, code="mllm-refused", status=422):
    """The multimodal LLM rejected the call as invalid."""


class MllmUnavailable(CowError, code="mllm-unavailable", status=503):
    """The multimodal LLM could not be reached."""


class GeneratorUnavailable(CowError, code="generator-unavailable", status=503):
    """The generator, the part that makes the frames, cannot run on this server."""


class WeightsUnavailable(GeneratorUnavailable, code="weights-unavailable"):
    """Model weights are missing, or differ from what was downloaded."""


class CheckpointInvalid(GeneratorUnavailable, code="checkpoint-invalid"):
    """A checkpoint does not fit the model."""


class GeneratorOutOfMemory(CowError, code="generator-out-of-memory", status=503):
    """The clip does not fit into the memory of the device."""


class DeviceFailed(CowError, code="device-failed", status=503):
    """The GPU failed while it made a clip."""


class ModelNotFound(CowError, code="model-not-found", status=404):
    """There is no model of that name."""


class JobNotFound(CowError, code="job-not-found", status=404):
    """There is no such job."""


class DownloadUnavailable(CowError, code="download-unavailable", status=409):
    """The job has no such file."""


class IdempotencyKeyReused(CowError, code="idempotency-key-reused", status=422):
    """The idempotency key was used for another request."""


class WebhookNotAllowed(CowError, code="webhook-not-allowed", status=422):
    """The server does not call that webhook."""


class QueueFull(CowError, code="queue-full", status=503):
    """The queue is full."""


class NotReady(CowError, code="not-ready", status=503):
    """The server is not ready yet."""


class ShuttingDown(CowError, code="shutting-down", status=503):
    """The server is stopping."""


class Canceled(CowError, code="canceled", status=409):
    """The work was canceled."""


class StorageUnavailable(CowError, code="storage-unavailable", status=503):
    """The data folder, the object store or the job database cannot be used."""


class WorkerEnded(CowError, code="worker-ended", status=500):
    """The process that computed the job ended before the job was finished."""


class JobTimeout(CowError, code="job-timeout", status=504):
    """The job took longer than this server allows."""


class InternalError(CowError, code="internal-error", status=500):
    """The server failed unexpectedly."""


def unforeseen() -> InternalError:
    """The error for any other exception, whose text may hold a secret."""
    return InternalError("An unexpected error happened in the server. Its log has the trace.")


def kinds(base: type[CowError] = CowError) -> dict[str, type[CowError]]:
    """Every error class that a response can carry, by its code."""
    found = {base.code: base}
    for kind in base.__subclasses__():
        if kind.__module__ == __name__:
            found |= kinds(kind)
    return found | {InternalError.code: InternalError}


@cache
def install_line(extra: str) -> str:
    """The command that installs an extra: editable where this package runs from a checkout, else by name."""
    try:
        origin = json.loads(distribution("cow-service").read_text("direct_url.json") or "{}")
    except PackageNotFoundError:
        origin = {}
    is_checkout = origin.get("dir_info", {}).get("editable", False)
    return f'pip install -e ".[{extra}]"' if is_checkout else f'pip install "cow-service[{extra}]"'
