"""Names of models: every reader is one, with imagination and without."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from cow_service.errors import FieldError, ModelNotFound, shortened
from cow_service.service import Service
from cow_service.settings import Settings

PREFIX = "cow/"
WITHOUT = ":no-imagination"  # a suffix: names of MLLMs may hold colons themselves
MLLM_READERS = ("mllm", "local")  # they serve the MLLM of the settings, and are called after it
SHOWN_CHARACTERS = 80  # of what the caller sent


@dataclass(frozen=True)
class Answerer:
    """What a model's name stands for."""

    reader: str
    imagine: Literal["always", "never"]


def answerers(service: Service) -> dict[str, Answerer]:
    """All models by name: the default reader first, as some callers take whatever comes first."""
    settings = service.settings
    found: dict[str, Answerer] = {}
    for reader in sorted(service.readers.names(), key=lambda name: name != settings.reader):
        name = _name_of(reader, settings)
        if name is not None:
            found[PREFIX + name] = Answerer(reader, "always")
            found[PREFIX + name + WITHOUT] = Answerer(reader, "never")
    return found


def answerer(service: Service, model: str) -> Answerer:
    """Who answers under that name. Raises `ModelNotFound`."""
    known = answerers(service)
    if model not in known:
        detail = f"There is no model '{shortened(model, SHOWN_CHARACTERS)}'. There are: {', '.join(known)}."
        raise ModelNotFound(detail, errors=(FieldError("/model", "no model has that name"),))
    return known[model]


def usable(service: Service) -> tuple[str, ...]:
    """The names of the models of which nothing is known that would keep them from answering."""
    unready = {reader.name for reader in service.models().readers if reader.ready is False}
    return tuple(name for name, one in answerers(service).items() if one.reader not in unready)


def _name_of(reader: str, settings: Settings) -> str | None:
    if reader not in MLLM_READERS:
        return reader
    serving = settings.reader if settings.reader in MLLM_READERS else "mllm"
    return settings.mllm if reader == serving else None
