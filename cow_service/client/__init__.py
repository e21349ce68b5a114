"""The SDK: ask a COW server from Python.

    from cow_service.client import Client

    client = Client("http://127.0.0.1:8000")
    answer = client.answer("photo.jpg", "If the toy car moves to the left, will it hit the vase? (A) Yes (B) No")

`AsyncClient` has the same calls for `await`. It needs httpx, httpx-sse and pydantic alone; Pillow and NumPy where
pictures are given or taken as such.
"""

from cow_service.client import errors
from cow_service.client.aio import AsyncClient, AsyncJobHandle
from cow_service.client.batches import Outcome
from cow_service.client.errors import CowError
from cow_service.client.events import Event
from cow_service.client.inputs import ImageLike
from cow_service.client.questions import Question, QuestionLike
from cow_service.client.results import Answer, AsyncAnswer, AsyncSimulation, Simulation
from cow_service.client.sync import Client, JobHandle

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
    "Outcome",
    "Question",
    "QuestionLike",
    "Simulation",
    "errors",
]
