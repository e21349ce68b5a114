"""Every error that a caller can meet.

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
    ├── MllmBadReply               mllm-bad-reply           502
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

An error's docstring is its title on the wire. Its message says what was wrong, with the value, and what to do about it;
it never holds a path, a trace or a secret. The SDK raises the same classes for the same codes.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

TYPE_PREFIX = "urn:cow:problem:"  # of the URI that a problem's code is part of: a name, not an address
MAX_DETAIL = 2000  # characters
MAX_FIELDS = 50  # of one error
MAX_KEY = 80  # characters


@dataclass(frozen=True)
class FieldError:
    """One invalid field of a request: a JSON Pointer (RFC 6901) and what is wrong there."""

    pointer: str
    detail: str


def pointer_part(part: int | str) -> str:
    """One step of a JSON Pointer, escaped (RFC 6901); a key of more than `MAX_KEY` characters is cut."""
    return shortened(str(part), MAX_KEY).replace("~", "~0").replace("/", "~1")


def field_of(pointer: str) -> str:
    """A JSON Pointer as messages name a field: `objects.0.mask` for /objects/0/mask."""
    return pointer[1:].replace("/", ".")


def shortened(text: str, most: int) -> str:
    """The text, or its first `most` characters and how many there are: what callers send may be megabytes long."""
    return text if len(text) <= most else f"{text[:most]}... ({len(text)} characters)"


class CowError(Exception):
    """Something went wrong."""

    code: str = "internal-error"
    status: int = 500
    request_id: str | None = None  # of the response that carried it, if any

    def __init__(
        self, detail: str, *, errors: tuple[FieldError, ...] = (), headers: dict[str, str] | None = None
    ) -> None:
        self.detail = shortened(detail, MAX_DETAIL)
        super().__init__(self.detail)
        self.errors = errors[:MAX_FIELDS]
        self.headers = headers or {}  # of the HTTP response
        self.usage: dict[str, Any] | None = None  # what was asked of a multimodal LLM before, where that was anything

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
        return problem if self.usage is None else problem | {"usage": self.usage}


class InvalidRequest(CowError):
    """The request is not valid."""

    code, status = "invalid-request", 422


class MalformedBody(InvalidRequest):
    """The body could not be read."""

    code, status = "malformed-body", 400


class NotFound(CowError):
    """There is nothing here."""

    code, status = "not-found", 404


class MethodNotAllowed(CowError):
    """This address does not take that method."""

    code, status = "method-not-allowed", 405


class Unauthorized(CowError):
    """The request has no valid key."""

    code, status = "unauthorized", 401


class OriginNotAllowed(CowError):
    """A web page from there may not use the server."""

    code, status = "origin-not-allowed", 403


class RateLimited(CowError):
    """Too many requests came in too short a time."""

    code, status = "rate-limited", 429


class ArtifactNotFound(CowError):
    """No artifact has that digest."""

    code, status = "artifact-not-found", 404


class RangeNotSatisfiable(CowError):
    """The range lies outside the artifact."""

    code, status = "range-not-satisfiable", 416


class BodyTooLarge(CowError):
    """The body is larger than the server takes."""

    code, status = "body-too-large", 413


class BodyTooSlow(CowError):
    """The body did not arrive in time."""

    code, status = "body-too-slow", 408


class BodyTypeUnsupported(CowError):
    """The body has a media type that the server does not take."""

    code, status = "body-type-unsupported", 415


class ImageTooLarge(CowError):
    """The image has more pixels than the server takes."""

    code, status = "image-too-large", 413


class ImageUnreadable(CowError):
    """The image could not be decoded."""

    code, status = "image-unreadable", 422


class ImageTypeUnsupported(CowError):
    """The image is not PNG, JPEG or WebP."""

    code, status = "image-type-unsupported", 415


class ImageUrlNotAllowed(CowError):
    """The image may not be fetched from that URL."""

    code, status = "image-url-not-allowed", 422


class ImageUrlUnreachable(CowError):
    """The image could not be fetched from its URL."""

    code, status = "image-url-unreachable", 422


class CannotGround(CowError):
    """An object that the question names could not be found, or not be used as it says."""

    code, status = "cannot-ground", 422


class ObjectNotFound(CannotGround):
    """The multimodal LLM did not see the object in the image."""

    code = "object-not-found"


class CannotReadDirection(CowError):
    """The direction of the motion could not be read."""

    code, status = "cannot-read-direction", 422


class ReaderUnavailable(CowError):
    """The reader cannot run on this server."""

    code, status = "reader-unavailable", 503


class MllmBadReply(CowError):
    """The multimodal LLM gave no reply that can be used."""

    code, status = "mllm-bad-reply", 502


class MllmUnavailable(CowError):
    """The multimodal LLM could not be asked."""

    code, status = "mllm-unavailable", 503


class GeneratorUnavailable(CowError):
    """The generator cannot run on this server."""

    code, status = "generator-unavailable", 503


class WeightsUnavailable(GeneratorUnavailable):
    """Weights are missing here, or are not those that were recorded when they were downloaded."""

    code = "weights-unavailable"


class CheckpointInvalid(GeneratorUnavailable):
    """A checkpoint does not fit the model."""

    code = "checkpoint-invalid"


class GeneratorOutOfMemory(CowError):
    """The clip does not fit into the memory of the device."""

    code, status = "generator-out-of-memory", 503


class DeviceFailed(CowError):
    """The GPU failed in the middle of a clip."""

    code, status = "device-failed", 503


class ModelNotFound(CowError):
    """No model has that name."""

    code, status = "model-not-found", 404


class JobNotFound(CowError):
    """There is no such job."""

    code, status = "job-not-found", 404


class DownloadUnavailable(CowError):
    """The job has no such file."""

    code, status = "download-unavailable", 409


class IdempotencyKeyReused(CowError):
    """The idempotency key belongs to another request."""

    code, status = "idempotency-key-reused", 422


class WebhookNotAllowed(CowError):
    """The server does not call that webhook."""

    code, status = "webhook-not-allowed", 422


class QueueFull(CowError):
    """The queue is full."""

    code, status = "queue-full", 503


class NotReady(CowError):
    """The server is not ready yet."""

    code, status = "not-ready", 503


class ShuttingDown(CowError):
    """The server is stopping."""

    code, status = "shutting-down", 503


class Canceled(CowError):
    """The work was canceled."""

    code, status = "canceled", 409


class StorageUnavailable(CowError):
    """The data folder, the object store or the job database cannot be used."""

    code, status = "storage-unavailable", 503


class WorkerEnded(CowError):
    """The process that computed the job ended before the job was done."""

    code, status = "worker-ended", 500


class JobTimeout(CowError):
    """The job took longer than this server allows."""

    code, status = "job-timeout", 504


class InternalError(CowError):
    """The server met an error of its own."""

    code, status = "internal-error", 500


def unforeseen() -> InternalError:
    """The error for an exception that is none of these, and whose text may tell what it should not."""
    return InternalError("The server met an error that it did not foresee; its log has the trace.")


def kinds(base: type[CowError] = CowError) -> dict[str, type[CowError]]:
    """Every kind of error that goes over the wire, by its code."""
    found = {base.code: base}
    for kind in base.__subclasses__():
        if kind.__module__ == __name__:
            found |= kinds(kind)
    return found | {InternalError.code: InternalError}
