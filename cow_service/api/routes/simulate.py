"""`POST /simulate`, `POST /answer` and `POST /look`."""

from typing import Any

from fastapi import APIRouter, Request, Response

from cow_service import errors
from cow_service.api.body import body_of
from cow_service.api.problems import documented
from cow_service.api.submission import JobSubmitter
from cow_service.records import Answer, Job, Look, Simulation
from cow_service.requests import AnswerRequest, LookRequest, SimulateRequest

_ELSEWHERE = (  # errors of the server as a whole, and of other operations
    errors.CowError, errors.InternalError, errors.NotFound, errors.MethodNotAllowed, errors.Unauthorized,
    errors.OriginNotAllowed, errors.RateLimited, errors.RangeNotSatisfiable, errors.ModelNotFound, errors.JobNotFound,
    errors.DownloadUnavailable, errors.NotReady,
)  # fmt: skip
FAILURES = tuple(kind for kind in errors.kinds().values() if kind not in _ELSEWHERE)
LOOK_FAILURES = (
    errors.PerceptionUnavailable, errors.PerceptionMissing, errors.InvalidRequest, errors.MalformedBody,
    errors.BodyTypeUnsupported, errors.BodyTooLarge, errors.BodyTooSlow, errors.ImageUnreadable, errors.ImageTooLarge,
    errors.ImageTypeUnsupported, errors.ImageUrlNotAllowed, errors.ImageUrlUnreachable, errors.ArtifactNotFound,
)  # fmt: skip
ACCEPTED: dict[int | str, dict[str, Any]] = {
    202: {
        "model": Job,
        "description": "The job, if `Prefer` limits the wait.",
        "headers": {
            "Location": {"description": "Address of the job.", "schema": {"type": "string"}},
            "Retry-After": {"description": "Seconds.", "schema": {"type": "string"}},
            "Preference-Applied": {"schema": {"type": "string"}},
        },
        "links": {
            name: {"operationId": name, "parameters": {"id": "$response.body#/id"}}
            for name in ("job", "request_of", "download", "events", "cancel", "delete")
        },
    }
}


def _header(name: str, description: str) -> dict[str, Any]:
    return {"name": name, "in": "header", "required": False, "description": description, "schema": {"type": "string"}}


KEY = _header(
    "Idempotency-Key",
    "The same key and body come to the same job, however often they are sent, but for one that failed with 503: it is "
    "tried again. A response of a job that was there before has the header `Idempotent-Replayed: true`.",
)
FRESH = _header("Cache-Control", "`no-cache`: use no cached results of earlier requests.")
WAIT = "`respond-async`: answer with the job at once; `wait=N`: after N seconds"
MINIMAL = "`return=minimal`: leave out what `Path` has per frame, but for `points` and `visible`"
PREFERENCES = [_header("Prefer", f"{WAIT} (RFC 7240)."), KEY, FRESH]
RESULT_PREFERENCES = [_header("Prefer", f"{WAIT}; {MINIMAL} (RFC 7240)."), KEY, FRESH]
RETURN = _header("Prefer", f"{MINIMAL} (RFC 7240).")


router = APIRouter()


@router.post(
    "/simulate",
    response_model=Simulation,
    tags=["simulation"],
    summary="Imagine the future of an image",
    responses={**ACCEPTED, **documented(*FAILURES)},
    openapi_extra={"requestBody": body_of(SimulateRequest), "parameters": RESULT_PREFERENCES},
)
async def simulate(request: Request, submitter: JobSubmitter) -> Response:
    """Finds what moves, reads its motion, computes its trajectory, renders it, and returns everything at once.

    A caller who closes the connection ends the work, a video model after the step that it is in, unless a header
    `Prefer` or `Idempotency-Key` says that somebody comes back.
    """
    return await submitter.run(request, "simulate", SimulateRequest)


@router.post(
    "/answer",
    response_model=Answer,
    tags=["answering"],
    summary="Look, then answer",
    responses={**ACCEPTED, **documented(*FAILURES)},
    openapi_extra={"requestBody": body_of(AnswerRequest), "parameters": RESULT_PREFERENCES},
)
async def answer(request: Request, submitter: JobSubmitter) -> Response:
    """Imagines the future of the image, then has the reader answer the question from the image and those frames.

    A simulation that fails does not lose the answer: it is then given from the image alone, and `warnings` says so.
    """
    return await submitter.run(request, "answer", AnswerRequest)


@router.post(
    "/look",
    response_model=Look,
    tags=["simulation"],
    summary="See what is at a place of an image",
    responses=documented(*LOOK_FAILURES),
    openapi_extra={"requestBody": body_of(LookRequest)},
)
async def look(request: Request, submitter: JobSubmitter) -> Look:
    """Outlines what the models of the server see at a point, in a box, or of what a question names. Makes no job.

    A point or a box needs a segmenter, or the small network that comes with COW; a question also needs a detector. A
    server without them answers `perception-missing`.
    """
    return await submitter.look(request)
