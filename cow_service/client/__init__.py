"""The SDK: ask a COW server from Python.

    from cow_service.client import Client

    client = Client("http://127.0.0.1:8000")
    answer = client.answer("photo.jpg", "If the toy car moves to the left, will it hit the vase? (A) Yes (B) No")

`AsyncClient` has the same calls for `await`. It needs httpx, httpx-sse and pydantic alone; Pillow and NumPy where
pictures are given or taken as such.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cow_service.client import errors
    from cow_service.client.async_client import AsyncClient
    from cow_service.client.async_results import AsyncAnswer, AsyncJobHandle, AsyncSimulation
    from cow_service.client.batches import BatchResult
    from cow_service.client.display import Models
    from cow_service.client.errors import CowError
    from cow_service.client.journal import Question, QuestionLike
    from cow_service.client.protocol import Event
    from cow_service.client.request import ImageLike
    from cow_service.client.sync_client import Client
    from cow_service.client.sync_results import Answer, JobHandle, Simulation

__all__ = ["Answer", "AsyncAnswer", "AsyncClient", "AsyncJobHandle", "AsyncSimulation", "BatchResult", "Client"]
__all__ += ["CowError", "Event", "ImageLike", "JobHandle", "Models", "Question", "QuestionLike", "Simulation", "errors"]

CONCURRENCY = 64  # most questions of a batch at the same time
# Each is imported on first use, so that a program with one client does not wait for the rest.
_MODULES = {
    "async_client": ("AsyncClient",),
    "async_results": ("AsyncAnswer", "AsyncJobHandle", "AsyncSimulation"),
    "batches": ("BatchResult",),
    "display": ("Models",),
    "errors": ("CowError",),
    "journal": ("Question", "QuestionLike"),
    "protocol": ("Event",),
    "request": ("ImageLike",),
    "sync_client": ("Client",),
    "sync_results": ("Answer", "JobHandle", "Simulation"),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name == "errors":
        return import_module("cow_service.client.errors")
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value = getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
