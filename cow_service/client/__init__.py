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
    from cow_service.client.batches import Outcome
    from cow_service.client.client import Client
    from cow_service.client.errors import CowError
    from cow_service.client.events import Event
    from cow_service.client.handles import AsyncJobHandle, JobHandle
    from cow_service.client.inputs import ImageLike
    from cow_service.client.models import Models
    from cow_service.client.questions import Question, QuestionLike
    from cow_service.client.results import Answer, AsyncAnswer, AsyncSimulation, Simulation

__all__ = [
    "Answer",
    "AsyncAnswer",
    "AsyncClient",
    "AsyncJobHandle",
    "AsyncSimulation",
    "Client",
    "CowError",
    "Event",
    "ImageLike",
    "JobHandle",
    "Models",
    "Outcome",
    "Question",
    "QuestionLike",
    "Simulation",
    "errors",
]

# Each is imported when it is first asked for: whoever uses one client need not wait for the rest.
_MODULES = {
    "Answer": "results",
    "AsyncAnswer": "results",
    "AsyncClient": "async_client",
    "AsyncJobHandle": "handles",
    "AsyncSimulation": "results",
    "Client": "client",
    "CowError": "errors",
    "Event": "events",
    "ImageLike": "inputs",
    "JobHandle": "handles",
    "Models": "models",
    "Outcome": "batches",
    "Question": "questions",
    "QuestionLike": "questions",
    "Simulation": "results",
}


def __getattr__(name: str) -> Any:
    if name == "errors":
        return import_module("cow_service.client.errors")
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
