"""Who may call: keys on every route, limits for each caller, and web pages that may not drive the server."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml
from asgi import app_of, ask
from conftest import ROOT
from fastapi import FastAPI
from servers import problem
from typer.testing import CliRunner

from cow_service.api.middleware.access import Buckets, address_of, hash_of, key_owner
from cow_service.cli.main import app as cow
from cow_service.settings import SettingsError, load_settings

ALICE, BOB = "cow_alice", "cow_bob"
KEYS = {"alice": hash_of(ALICE), "bob": hash_of(BOB)}
PAGE = "https://app.example.org"
SECRET = "whsec_" + base64.b64encode(bytes(24)).decode()
PROBES = {("GET", "/livez"), ("GET", "/readyz")}
OPERATIONS = [
    (method.upper(), re.sub(r"\{\w+\}", "0" * 64, path))
    for path, operations in yaml.safe_load((ROOT / "openapi.yaml").read_text())["paths"].items()
    for method in operations
]
UNKNOWN = [
    *(("POST", path) for path in ("/", "/docs", "/livez")),
    *(("GET", path) for path in ("/docs.json", "/web", "/openapi.json", "/nowhere", "/livez/", "/%2Flivez")),
    *((method, "/models") for method in ("DELETE", "OPTIONS", "PROPFIND")),
]


def bearer(key: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {key}"}


@pytest.fixture(scope="module")
def app_with(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., FastAPI]:
    """Apps without limits of rates, one for each set of settings: making one takes long."""

    @cache
    def make(keys: bool = False, **settings: Any) -> FastAPI:
        return app_of(tmp_path_factory.mktemp("app"), **settings, **({"api_keys": KEYS} if keys else {}))

    return make


@pytest.fixture
def closed(app_with: Callable[..., FastAPI]) -> FastAPI:
    return app_with(keys=True)


def test_nothing_but_probes_without_a_key(closed: FastAPI) -> None:
    assert {("POST", "/simulate"), ("GET", "/metrics"), *PROBES} <= set(OPERATIONS)
    for method, path in [*OPERATIONS, *UNKNOWN]:
        asked = [(method, path, headers) for headers in ({}, bearer("cow_eve"), bearer(ALICE))]
        *refused, right = ask(closed, *asked)
        assert right.status_code != 401
        for response in refused:
            if (method, path) in PROBES:
                assert response.status_code in (200, 503)  # as if there were no keys
            else:
                error = problem(response, 401, "unauthorized").get("error")
                assert (error or {}).get("type") == ("authentication_error" if path.startswith("/v1/") else None)
                assert response.headers["www-authenticate"] == "Bearer"
                assert response.headers["x-content-type-options"] == "nosniff"
                assert "cow_eve" not in response.text


def test_how_a_key_is_sent(closed: FastAPI) -> None:
    right = [f"Bearer {ALICE}", f"bearer  {BOB} "]
    wrong = [f"Basic {ALICE}", ALICE, "Bearer", "Bearer ", f"Bearer {ALICE}, Bearer {BOB}", f"Bearer {KEYS['alice']}"]
    sent = [[("Authorization", header.encode("latin-1"))] for header in (*right, *wrong, "Bearer k\xe4se")]
    sent.append([("Authorization", b"Bearer " + key.encode()) for key in (ALICE, BOB)])
    responses = ask(closed, *(("GET", "/nowhere", headers) for headers in sent))
    assert [response.status_code for response in responses] == [404] * 2 + [401] * 8


def test_cow_keys_new(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("COW_API_KEYS", raising=False)
    for name in ("alice", "bob"):
        shown = CliRunner().invoke(cow, ["keys", "new", name])
        assert shown.exit_code == 0
        monkeypatch.setenv("COW_API_KEYS", re.search(r"COW_API_KEYS='(.*)'", shown.output)[1])
        assert key_owner(re.search(r"(cow_\S+)", shown.output)[1], load_settings().api_keys) == name
    assert set(load_settings().api_keys) == {"alice", "bob"}
    assert [CliRunner().invoke(cow, ["keys", "new", name]).exit_code for name in ("bob", "a b")] == [1, 1]


def test_plain_keys_stop_the_start_and_are_not_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    hashes = ('{"a": "sha256:' + "g" * 64 + '"}', f'{{"a": "{KEYS["alice"]}", "b": "{KEYS["alice"]}"}}')
    for value in ('{"alice": "cow_secret"}', '{"cow secret": "sha256:00"}', '["cow_secret"]', "cow_secret", *hashes):
        monkeypatch.setenv("COW_API_KEYS", value)
        with pytest.raises(SettingsError, match="COW_API_KEYS") as caught:
            load_settings()
        assert "secret" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("COW_RATE_LIMIT", ["0"]),
        ("COW_CORS_ORIGINS", [PAGE, *(f'["{each}"]' for each in (PAGE + "/", PAGE[8:], PAGE.upper(), "null", "*"))]),
        ("COW_WEBHOOK_SECRET", [SECRET + "!", "whsec_" + SECRET[10:], SECRET[1:], " ".join([SECRET] * 3)]),
        ("COW_ARTIFACTS", ["ftp://store", "s3://name:password@store"]),
        ("COW_ADMIN_KEYS", ['["eve"]']),
        ("COW_KEY_WEIGHTS", ['{"eve": 2}']),
        ("COW_MAX_BODY_MB", ["nan", "inf", "0"]),
    ],
)
def test_bad_settings_are_named(monkeypatch: pytest.MonkeyPatch, name: str, values: list[str]) -> None:
    for value in values:
        monkeypatch.setenv(name, value)
        with pytest.raises(SettingsError, match=name):
            load_settings()


def test_settings_that_are_used(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {
        "WEBHOOK_SECRET": f"{SECRET} {SECRET}",
        "ARTIFACTS": "s3://store/prefix/",
        "LOG_LEVEL": "",
    }.items():
        monkeypatch.setenv(f"COW_{name}", value)
    monkeypatch.setenv("COW_API_KEYS", f'{{"a": "{KEYS["alice"]}", "b": "{KEYS["bob"]}"}}')
    found = load_settings(queue_limit=9, admin_keys=("a",), port=None)
    assert (found.port, found.log_level, found.own_queue_limit) == (8000, "info", 4)
    assert load_settings(queue_limit=9, queue_limit_per_key=7).own_queue_limit == 7
    assert [found.is_admin(owner) for owner in ("a", "b", None)] == [True, False, True]
    assert (found.reader, load_settings(mllm="generic").reader) == ("embedded", "mllm")


# --- how often ---


def test_each_key_has_its_own_limit(tmp_path: Path) -> None:
    app = app_of(tmp_path, api_keys=KEYS, rate_limit=2)
    alice, bob = ("GET", "/nowhere", bearer(ALICE)), ("GET", "/nowhere", bearer(BOB))
    *passed, refused = ask(app, alice, alice, ("GET", "/v1/models", bearer(ALICE)))
    assert [response.status_code for response in passed] == [404, 404]
    assert problem(refused, 429, "rate-limited")["error"]["type"] == "rate_limit_error"
    assert 1 <= int(refused.headers["retry-after"]) <= 30
    assert [response.status_code for response in ask(app, bob, bob, bob)] == [404, 404, 429]
    assert [response.status_code for response in ask(app, *[("GET", "/livez")] * 5)] == [200] * 5


def test_without_keys_each_address_has_its_own_limit(tmp_path: Path) -> None:
    app = app_of(tmp_path, rate_limit=1)
    assert [r.status_code for r in ask(app, ("GET", "/nowhere"), ("GET", "/nowhere"))] == [404, 429]
    assert ask(app, ("GET", "/nowhere"), client="192.0.2.2")[0].status_code == 404
    assert ask(app, ("GET", "/nowhere"), client="2001:db8::1")[0].status_code == 404
    assert ask(app, ("GET", "/nowhere"), client="2001:db8::2")[0].status_code == 429
    clients = [("fe80::1%eth0", 7), None, ("testclient", 1)]
    assert [address_of({"client": client}) for client in clients] == ["fe80::/64", "unknown", "testclient"]


@pytest.mark.parametrize(
    ("setting", "per_minute", "unit"),
    [("rate_limit_mb", 1.0, "1 MB of bodies"), ("rate_limit_cpu", 1e-6, "1e-06 CPU seconds for reading bodies")],
)
def test_what_refused_requests_use_counts(tmp_path: Path, setting: str, per_minute: float, unit: str) -> None:
    app = app_of(tmp_path, api_keys=KEYS, **{setting: per_minute})
    alice, bob = (
        ("POST", "/v1/chat/completions", {**bearer(key), "Content-Type": "application/json"}, b"{" + b" " * 1_500_000)
        for key in (ALICE, BOB)
    )
    first, refused, of_bob = ask(app, alice, alice, bob)
    problem(first, 400, "malformed-body")
    assert unit in problem(refused, 429, "rate-limited")["detail"]
    assert int(refused.headers["retry-after"]) >= 1
    problem(of_bob, 400, "malformed-body")


def test_wrong_keys_are_counted_and_right_ones_pass(tmp_path: Path) -> None:
    app = app_of(tmp_path, api_keys=KEYS, rate_limit=1000)
    responses = ask(app, *[("GET", "/models", bearer(f"cow_{i}")) for i in range(32)])
    assert {response.status_code for response in responses[:30]} == {401}
    assert responses[31].status_code == 429
    assert responses[31].headers["retry-after"]
    assert ask(app, ("GET", "/models", bearer(ALICE)))[0].status_code == 200
    assert ask(app, ("GET", "/models"), client="192.0.2.2")[0].status_code == 401


def test_buckets_fill_again_and_are_bounded() -> None:
    now = 0.0
    buckets = Buckets(6, most=3, clock=lambda: now)
    assert [buckets.take("a") for _ in range(6)] == [0] * 6
    assert buckets.take("a") == pytest.approx(10)
    now = 9.0
    assert buckets.take("a") == pytest.approx(1)
    now = 10.1
    assert buckets.take("a") == 0
    now = 10_000.0
    assert [buckets.take("a") for _ in range(7)][-2:] == [0, pytest.approx(10)]
    for name in "bcdefg":
        buckets.take(name)
    assert len(buckets) == 3


# --- web pages ---


@pytest.mark.parametrize("listed", [(), (PAGE,)])
def test_a_foreign_page_is_refused(app_with: Callable[..., FastAPI], listed: tuple[str, ...]) -> None:
    origins = ("https://evil.example", "null", "http://cow:8001", "http://cow", "file://", "", PAGE + ".evil.example")
    asked = [("GET", "/models"), ("POST", "/simulate"), ("OPTIONS", "/simulate"), ("GET", "/livez"), ("GET", "/x")]
    preflight = {"Access-Control-Request-Method": "POST"}
    requests = [(method, path, {"Origin": origin} | preflight) for origin in origins for method, path in asked]
    for response in ask(app_with(cors_origins=listed), *requests):
        problem(response, 403, "origin-not-allowed")
        assert "access-control-allow-origin" not in response.headers


def test_its_own_pages_may_use_the_server(app_with: Callable[..., FastAPI]) -> None:
    places = [
        ("http://cow:8000", "cow:8000"),
        ("http://COW:8000", "cow:8000"),
        ("http://localhost", "localhost:80"),
        ("https://localhost", "localhost"),
        ("http://[::1]:8000", "[::1]:8000"),
    ]
    app = app_with(cors_origins=())
    for response in ask(app, *(("GET", "/livez", {"Origin": o, "Host": host}) for o, host in places)):
        assert response.status_code == 200
        assert not [name for name in response.headers if name.startswith("access-control")]


def test_a_listed_page_gets_cors_headers_whatever_comes_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    app = app_of(tmp_path, cors_origins=(PAGE,), api_keys=KEYS)
    headers = {"Origin": PAGE}

    @app.get("/broken")
    async def broken() -> None:
        raise RuntimeError

    asked = {"Access-Control-Request-Method": "POST", "Access-Control-Request-Headers": "authorization, prefer"}
    responses = ask(
        app,
        ("OPTIONS", "/simulate", headers | asked),
        ("GET", "/models", headers),
        ("GET", "/models", headers | bearer(ALICE)),
        ("GET", "/nowhere", headers | bearer(ALICE)),
        ("GET", "/broken", headers | bearer(ALICE)),
    )
    assert [response.status_code for response in responses] == [200, 401, 200, 404, 500]
    for response in responses:
        assert response.headers["access-control-allow-origin"] == PAGE
        assert "Origin" in response.headers["vary"]
        assert response.headers["x-request-id"]
    assert {"Authorization", "Idempotency-Key", "Last-Event-ID", "Prefer", "traceparent"} <= set(
        responses[0].headers["access-control-allow-headers"].split(", ")
    )
    assert responses[1].headers["access-control-expose-headers"] == "X-Request-Id, Location, Retry-After, traceparent"


def test_every_page_may_come_where_keys_are_asked_for(tmp_path: Path) -> None:
    app = app_of(tmp_path, cors_origins=("*",), api_keys=KEYS)
    response = ask(app, ("GET", "/models", {"Origin": "https://any.example"} | bearer(ALICE)))[0]
    assert response.headers["access-control-allow-origin"] == "*"


@pytest.mark.parametrize(
    ("settings", "statuses"),
    [
        ({"cors_origins": (PAGE,)}, (403, 200)),
        ({"host": "0.0.0.0"}, (200, 200)),
        ({"keys": True}, (200, 200)),
    ],
)
def test_a_page_cannot_rename_this_machine(
    app_with: Callable[..., FastAPI], settings: dict[str, Any], statuses: tuple[int, int]
) -> None:
    app = app_with(**settings)
    foreign = ("evil.example:8000", "evil.example", "127.0.0.1.evil.example", "localhost.evil.example")
    local = ("localhost:8000", "cow.localhost", "127.0.0.1:8000", "[::1]:8000", "[::ffff:127.0.0.1]", "cow", "")
    if settings.get("cors_origins"):
        local += ("app.example.org",)
    for hosts, status in zip((foreign, local), statuses, strict=True):
        for response in ask(app, *(("GET", "/livez", {"Host": host}) for host in hosts)):
            assert response.status_code == status
