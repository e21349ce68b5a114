"""When the server says that it is ready: not while backends load, not without room, not without a database."""

from __future__ import annotations

import threading

import httpx
import pytest
from engines import app_for, running_engine
from test_contract import get

from cow_service.api.app import create_app
from cow_service.errors import GeneratorUnavailable, NotReady, StorageUnavailable
from cow_service.jobs import readiness
from cow_service.jobs.readiness import Readiness
from cow_service.service import Service


def test_not_while_loading(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    loaded = threading.Event()
    check = service.check
    monkeypatch.setattr(service, "check", lambda: loaded.wait(10) and check())
    app_for(service)
    ready = Readiness(service)
    app = create_app(running_engine(), ready)
    ready.start()
    answer = get(app, "/readyz")
    assert (answer.status_code, answer.json()["type"]) == (503, "urn:cow:problem:not-ready")
    assert answer.headers["retry-after"]
    assert get(app, "/livez").status_code == 200
    with pytest.raises(NotReady):
        ready.check()
    loaded.set()
    ready.wait(10)
    assert get(app, "/readyz").status_code == 200


def test_what_cannot_be_loaded_is_told(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    def check() -> None:
        raise GeneratorUnavailable("It has no GPU.")

    monkeypatch.setattr(service, "check", check)
    told = threading.Event()
    ready = Readiness(service)
    ready.start(told.set)
    assert told.wait(10)
    with pytest.raises(GeneratorUnavailable, match="no GPU"):
        ready.wait(0)


def test_not_on_a_full_disk(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(readiness, "MIN_FREE_BYTES", 10**18)
    service.check()
    with pytest.raises(StorageUnavailable, match="MB left"):
        Readiness(service).check()


def test_not_without_a_database(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    def check() -> None:
        raise StorageUnavailable("The job database cannot be used.")

    app = app_for(service)
    monkeypatch.setattr(running_engine().database, "check", check)
    answer: httpx.Response = get(app, "/readyz")
    assert (answer.status_code, answer.json()["type"]) == (503, "urn:cow:problem:storage-unavailable")
