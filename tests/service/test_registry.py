"""Backends by name, each made by a lazy factory."""

from __future__ import annotations

from importlib.metadata import EntryPoint

import pytest
from refusals import refused

from cow_service import errors, registry
from cow_service.registry import Registry
from cow_service.settings import Settings

TRIES: list[Settings] = []


def create(settings: Settings) -> object:
    """A factory that succeeds at the second try."""
    TRIES.append(settings)
    if len(TRIES) == 1:
        raise errors.WeightsUnavailable("Pull them.")
    return object()


def registry_of(monkeypatch: pytest.MonkeyPatch, factory: str) -> Registry:
    monkeypatch.setattr(registry, "entry_points", lambda group: (EntryPoint("far", factory, group),))
    return Registry("none", errors.GeneratorUnavailable, Settings())


def test_a_backend_that_cannot_be_imported_is_unavailable(monkeypatch: pytest.MonkeyPatch) -> None:
    found: Registry = registry_of(monkeypatch, "no_such_package.far:create")
    with refused("generator-unavailable") as caught:
        found.get("far")
    assert "'no_such_package'" in caught.value.detail
    with pytest.raises(KeyError):
        found.get("near")
    assert found.names() == ("far",)


def test_a_backend_that_failed_to_load_is_not_tried_at_every_request(monkeypatch: pytest.MonkeyPatch) -> None:
    found: Registry = registry_of(monkeypatch, f"{__name__}:create")
    for _ in range(3):
        with refused("weights-unavailable"):
            found.get("far")
    assert len(TRIES) == 1
    assert not found.is_made("far")
    monkeypatch.setattr(registry, "RETRY_SECONDS", 0.0)
    assert found.get("far") is found.get("far")
    assert (len(TRIES), found.is_made("far")) == (2, True)
