"""When the server says that it is ready: not while backends load, not without room, not without a database."""

from __future__ import annotations

import threading

import pytest
from asgi import get
from engines import app_for, running_engine
from refusals import refused
from servers import problem
from waiting import TIME_LIMIT

from cow_service.api.app import create_app
from cow_service.errors import StorageUnavailable
from cow_service.jobs import readiness
from cow_service.jobs.readiness import Readiness
from cow_service.service import Service


def test_not_while_loading_and_not_without_a_database(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    loaded = threading.Event()
    check = service.check
    monkeypatch.setattr(service, "check", lambda: loaded.wait(TIME_LIMIT) and check())
    app_for(service)
    ready = Readiness(service)
    app = create_app(running_engine(), ready)
    ready.start()
    response = get(app, "/readyz")
    problem(response, 503, "not-ready")
    assert response.headers["retry-after"] == "5"
    assert get(app, "/livez").status_code == 200
    loaded.set()
    ready.wait(TIME_LIMIT)
    assert get(app, "/readyz").status_code == 200

    def is_away() -> None:
        raise StorageUnavailable("The job database cannot be used.")

    monkeypatch.setattr(running_engine().database, "check", is_away)
    problem(get(app, "/readyz"), 503, "storage-unavailable")


def test_not_on_a_full_disk(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(readiness, "MIN_FREE_BYTES", 10**18)
    service.check()
    with refused("storage-unavailable"):
        Readiness(service).check()
