"""What a job has to do: JSON values that the job database keeps from the moment that the request is accepted."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from cow_service.records import AcceptedRequest, JobKind, Record
from cow_service.requests import AnswerRequest, Priority, SimulateRequest
from cow_service.stages.keys import digest_of


class JobSpec(Record):
    """One accepted request. Its image and masks are artifacts: a spec has no bytes. Databases store the field names."""

    kind: JobKind
    request: dict[str, Any]
    reader: str = Field(description="As the server chose it, where the request names none.")
    generator: str = Field(description="As the server chose it, where the request names none.")
    created_at: str = Field(description="RFC 3339, UTC.")
    fresh: bool = Field(default=False, description="Take no results of other jobs.")
    webhook: str | None = Field(default=None, description="URL to call when the job has ended.")
    priority: Priority = Field(default="normal", description="Among the waiting jobs of its key.")
    turn: int = Field(default=0, ge=0, description="Its place among the jobs of all keys: the lower comes first.")
    request_id: str | None = None
    traceparent: str | None = None

    @property
    def digest(self) -> str:
        """Equal for requests that ask for the same."""
        return digest_of({"kind": self.kind, "request": self.request, "fresh": self.fresh, "webhook": self.webhook})

    @property
    def question(self) -> str:
        """What was asked."""
        question: str = self.request["question"]
        return question

    @property
    def image(self) -> str:
        """The digest of the image."""
        digest: str = self.request["image"]["artifact"]
        return digest

    @property
    def masks(self) -> list[str]:
        """The digests of the masks that the request gives."""
        places = [self.request.get("grounding") or {}, *self.request.get("objects", ())]
        return [place["mask"]["artifact"] for place in places if place.get("mask")]

    def accepted(self) -> AcceptedRequest:
        """The request as its caller may send it again."""
        priority = {} if self.priority == "normal" else {"priority": self.priority}
        return AcceptedRequest(kind=self.kind, request=self.request | priority)

    def parsed(self) -> SimulateRequest | AnswerRequest:
        """The request, as it was validated when it came."""
        model = AnswerRequest if self.kind == "answer" else SimulateRequest
        return model.model_validate({**self.request, "reader": self.reader, "generator": self.generator})
