"""Errors as text from which a model can do better: the code, what was wrong, and what to do with these tools."""

from __future__ import annotations

from cow_service.client import CowError

_GIVE_PLACE = (
    "Look at the image and call again with `bbox` [x0, y0, x1, y1] or `point` [x, y] of the thing that moves, in "
    "pixels of the image, and `object`, its name; give other things that the question names in `objects`, each with "
    "`object` and `bbox`."
)
_RETRY_LATER = "Call again in a while, with the same arguments."
REMEDIES = {
    "cannot-ground": _GIVE_PLACE,
    "object-not-found": _GIVE_PLACE,
    "cannot-read-direction": "Call again with `direction` [dx, dy] (x right, y down; [-1, 0] is to the left), or with "
    '`motion_kind` "fall" where it is dropped.',
    "artifact-not-found": "Send the image itself: the server keeps none of that digest for you.",
    "image-url-not-allowed": "Give the image itself instead of its address. Which addresses are fetched is set by "
    "COW_ALLOW_IMAGE_URLS of the server.",
    "image-url-unreachable": "Check the address, or give the image itself.",
    "unauthorized": "The person who set up this tool has to give it a valid key: COW_API_KEY in the environment of "
    "`cow mcp`, or the header `Authorization: Bearer <key>` where it is reached over HTTP.",
    "queue-full": _RETRY_LATER,
    "rate-limited": _RETRY_LATER,
    "shutting-down": _RETRY_LATER,
    "not-ready": _RETRY_LATER,
    "mllm-unavailable": "Call again in a while, or with another `reader` ('embedded' needs no model).",
    "canceled": "Somebody canceled the job. Call again if it is still wanted.",
}
# Where the service's requests have a field, and the tools an argument.
_ARGUMENTS = {
    "/grounding": "",
    "/motion/kind": "/motion_kind",
    "/motion": "",
    "/frames/policy": "/frames_policy",
    "/frames/count": "/frames_count",
}


def error_text(error: CowError) -> str:
    """An error, for a model to read."""
    lines = [f"{error.code}: {error.title}"]
    # The detail says the same as the fields do, in words of the service's requests.
    lines += [f"- {_argument(field.pointer)}: {field.detail}" for field in error.errors] or [error.detail]
    if error.code in REMEDIES:
        lines.append(f"What to do: {REMEDIES[error.code]}")
    if error.request_id is not None:
        lines.append(f"(request id {error.request_id})")
    return "\n".join(lines)


def _argument(pointer: str) -> str:
    """The argument of a tool that a JSON Pointer into the service's request means."""
    begin = next((known for known in _ARGUMENTS if pointer == known or pointer.startswith(f"{known}/")), None)
    if begin is None:
        return pointer.lstrip("/") or "arguments"
    argument = (_ARGUMENTS[begin] + pointer[len(begin) :]).lstrip("/")
    return argument or ("`object`, `bbox`, `point`" if begin == "/grounding" else "`direction`, `motion_kind`, `speed`")
