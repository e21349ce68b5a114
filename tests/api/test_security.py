"""Who may call: keys on every route, limits for each caller, and web pages that may not drive the server."""

from __future__ import annotations

import asyncio
import re
from pathlib import Path

import httpx
import pytest
import yaml
from conftest import ROOT
from fastapi import FastAPI, Request
from typer.testing import CliRunner

from cow_service.api.app import create_app
from cow_service.api.middleware.access import Buckets, address_of, hash_of, key_owner, new_key
from cow_service.cli.main import app as cow
from cow_service.jobs.engine import JobEngine
from cow_service.service import Service
from cow_service.settings import Settings, SettingsError, load_settings

ALICE, BOB = "cow_alice", "cow_bob"
KEYS = {"alice": hash_of(ALICE), "bob": hash_of(BOB)}
PROBES = {("GET", "/livez"), ("GET", "/readyz")}
OPERATIONS = [
    (method.upper(), re.sub(r"\{\w+\}", "0" * 64, path))
    for path, operations in yaml.safe_load((ROOT / "openapi.yaml").read_text())["paths"].items()
    for method in operations
]
UNKNOWN = [
    ("POST", "/"),
    ("POST", "/docs"),
    ("GET", "/docs.json"),
    ("GET", "/web"),
    ("GET", "/openapi.json"),
    ("GET", "/nowhere"),
    ("POST", "/livez"),
    ("GET", "/livez/"),
    ("GET", "/%2Flivez"),
    ("GET", "/livez/../models"),
    ("DELETE", "/models"),
    ("OPTIONS", "/models"),
    ("PROPFIND", "/models"),
]


def app_of(tmp_path: Path, **settings: object) -> FastAPI:
    """An app whose engine does not run: the requests here need no job."""
    return create_app(JobEngine(Service(Settings(data_dir=tmp_path / "data", **settings))))


def ask(
    app: FastAPI, *requests: tuple[str, str] | tuple[str, str, dict[str, str]], client: str = "192.0.2.1"
) -> list[httpx.Response]:
    """The responses to a few requests: method, path, headers."""

    async def run() -> list[httpx.Response]:
        transport = httpx.ASGITransport(app, raise_app_exceptions=False, client=(client, 1))
        async with httpx.AsyncClient(transport=transport, base_url="http://cow:8000", timeout=20) as http:
            return [await http.request(method, path, headers=dict(*headers)) for method, path, *headers in requests]

    return asyncio.run(run())


def bearer(key: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {key}"}


def code(response: httpx.Response) -> str:
    return response.json()["type"].removeprefix("urn:cow:problem:")


@pytest.fixture(scope="module")
def closed(tmp_path_factory: pytest.TempPathFactory) -> FastAPI:
    return app_of(tmp_path_factory.mktemp("closed"), api_keys=KEYS)


def test_the_contract_lists_routes_to_try() -> None:
    assert {("POST", "/simulate"), ("GET", "/metrics"), *PROBES} <= set(OPERATIONS)


@pytest.mark.parametrize(("method", "path"), [*OPERATIONS, *UNKNOWN])
def test_nothing_but_probes_without_a_key(closed: FastAPI, method: str, path: str) -> None:
    without, wrong, right = ask(
        closed, (method, path), (method, path, bearer("cow_eve")), (method, path, bearer(ALICE))
    )
    assert right.status_code != 401
    for response in (without, wrong):
        if (method, path) in PROBES:
            assert response.status_code in (200, 503)  # as if there were no keys
        else:
            assert response.status_code == 401
            assert code(response) == "unauthorized"
            assert response.headers["www-authenticate"] == "Bearer"
            assert response.headers["x-content-type-options"] == "nosniff"
            assert "cow_eve" not in response.text


def test_pages_are_served_without_a_key(closed: FastAPI) -> None:
    asked = [(method, path) for method in ("GET", "HEAD") for path in ("/docs", "/docs/start.js")]
    assert [response.status_code for response in ask(closed, *asked)] == [200] * 4
    (unknown,) = ask(closed, ("GET", "/docs/nothing.js"))
    assert unknown.status_code == 404


def test_no_keys_no_questions(tmp_path: Path) -> None:
    assert ask(app_of(tmp_path), ("GET", "/models"))[0].status_code == 200


@pytest.mark.parametrize(
    ("header", "status"),
    [
        (f"Bearer {ALICE}", 404),
        (f"bearer  {BOB} ", 404),
        (f"Basic {ALICE}", 401),
        (ALICE, 401),
        ("Bearer", 401),
        ("Bearer ", 401),
        (f"Bearer {ALICE}, Bearer {BOB}", 401),
        (f"Bearer {KEYS['alice']}", 401),
        ("Bearer k\xe4se", 401),
    ],
)
def test_how_a_key_is_sent(closed: FastAPI, header: str, status: int) -> None:
    request = ("GET", "/nowhere", {"Authorization": header.encode("latin-1")})
    assert ask(closed, request)[0].status_code == status  # type: ignore[arg-type]


def test_two_headers_are_none(closed: FastAPI) -> None:
    async def run() -> int:
        transport = httpx.ASGITransport(closed)
        async with httpx.AsyncClient(transport=transport, base_url="http://cow") as http:
            headers = [("Authorization", f"Bearer {ALICE}"), ("Authorization", f"Bearer {BOB}")]
            return (await http.get("/models", headers=headers)).status_code

    assert asyncio.run(run()) == 401


@pytest.mark.parametrize(
    ("keys", "headers", "owner"), [(KEYS, bearer(BOB), "bob"), ({}, bearer(BOB), None), ({}, {}, None)]
)
def test_routes_know_the_owner(tmp_path: Path, keys: dict, headers: dict, owner: str | None) -> None:
    app = app_of(tmp_path, api_keys=keys)

    @app.get("/whoami")
    async def whoami(request: Request) -> dict[str, str | None]:
        return {"owner": request.state.owner}

    assert ask(app, ("GET", "/whoami", headers))[0].json() == {"owner": owner}


def test_a_key_is_its_owners_only() -> None:
    key, other = new_key(), new_key()
    assert re.fullmatch(r"cow_[\w-]{43}", key)
    assert [key_owner(each, {"a": hash_of(key)}) for each in (key, other, "")] == ["a", None, None]


def test_cow_keys_new(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("COW_API_KEYS", raising=False)
    shown = CliRunner().invoke(cow, ["keys", "new", "alice"])
    assert shown.exit_code == 0
    key, setting = re.search(r"(cow_\S+)", shown.output)[1], re.search(r"COW_API_KEYS='(.*)'", shown.output)[1]
    monkeypatch.setenv("COW_API_KEYS", setting)
    assert key_owner(key, load_settings().api_keys) == "alice"
    both = CliRunner().invoke(cow, ["keys", "new", "bob"])
    monkeypatch.setenv("COW_API_KEYS", re.search(r"COW_API_KEYS='(.*)'", both.output)[1])
    assert key_owner(key, load_settings().api_keys) == "alice"
    assert set(load_settings().api_keys) == {"alice", "bob"}
    assert CliRunner().invoke(cow, ["keys", "new", "bob"]).exit_code == 1
    assert "cannot be the name of a key" in CliRunner().invoke(cow, ["keys", "new", "a b"]).output


@pytest.mark.parametrize(
    "value",
    [
        '{"alice": "cow_secret"}',
        '{"cow secret": "sha256:00"}',
        '["cow_secret"]',
        '"cow_secret"',
        '{"a": "sha256:' + "g" * 64 + '"}',
        f'{{"a": "{KEYS["alice"]}", "b": "{KEYS["alice"]}"}}',
        "cow_secret",
    ],
)
def test_plain_keys_stop_the_start_and_are_not_repeated(monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    monkeypatch.setenv("COW_API_KEYS", value)
    with pytest.raises(SettingsError, match="COW_API_KEYS") as caught:
        load_settings()
    assert "secret" not in str(caught.value)
    if value.startswith("{"):
        assert "cow keys new NAME" in str(caught.value)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("COW_RATE_LIMIT", "0"),
        ("COW_RATE_LIMIT", "often"),
        ("COW_CORS_ORIGINS", '["https://app.example.org/"]'),
        ("COW_CORS_ORIGINS", '["app.example.org"]'),
        ("COW_CORS_ORIGINS", '["https://App.example.org"]'),
        ("COW_CORS_ORIGINS", '["null"]'),
        ("COW_CORS_ORIGINS", '["*"]'),
        ("COW_CORS_ORIGINS", "https://app.example.org"),
        ("COW_LOG_FORMAT", "xml"),
        ("COW_LOG_LEVEL", "loud"),
    ],
)
def test_bad_settings_are_named(monkeypatch: pytest.MonkeyPatch, name: str, value: str) -> None:
    monkeypatch.setenv(name, value)
    with pytest.raises(SettingsError, match=name):
        load_settings()


# --- how often ---


def test_each_key_has_its_own_limit(tmp_path: Path) -> None:
    app = app_of(tmp_path, api_keys=KEYS, rate_limit=2)
    alice, bob = ("GET", "/nowhere", bearer(ALICE)), ("GET", "/nowhere", bearer(BOB))
    *passed, refused = ask(app, alice, alice, alice)
    assert [response.status_code for response in passed] == [404, 404]
    assert refused.status_code == 429
    assert code(refused) == "rate-limited"
    assert 1 <= int(refused.headers["retry-after"]) <= 30
    assert [response.status_code for response in ask(app, bob, bob, bob)] == [404, 404, 429]
    assert [response.status_code for response in ask(app, *[("GET", "/livez")] * 5)] == [200] * 5


def test_without_keys_each_address_has_its_own_limit(tmp_path: Path) -> None:
    app = app_of(tmp_path, rate_limit=1)
    assert [r.status_code for r in ask(app, ("GET", "/nowhere"), ("GET", "/nowhere"))] == [404, 429]
    assert ask(app, ("GET", "/nowhere"), client="192.0.2.2")[0].status_code == 404
    assert ask(app, ("GET", "/nowhere"), client="2001:db8::1")[0].status_code == 404
    assert ask(app, ("GET", "/nowhere"), client="2001:db8::2")[0].status_code == 429


@pytest.mark.parametrize(
    ("setting", "per_minute", "unit"),
    [("rate_limit_mb", 1.0, "1 MB of bodies"), ("rate_limit_cpu", 1e-6, "1e-06 CPU seconds for reading bodies")],
)
def test_what_refused_requests_use_counts(tmp_path: Path, setting: str, per_minute: float, unit: str) -> None:
    app = app_of(tmp_path, api_keys=KEYS, **{setting: per_minute})
    unfinished = {"content": b"{" + b" " * 1_500_000}

    async def run() -> tuple[list[httpx.Response], httpx.Response]:
        transport = httpx.ASGITransport(app, raise_app_exceptions=False)
        async with httpx.AsyncClient(transport=transport, base_url="http://cow:8000") as http:
            alice, bob = ({**bearer(key), "Content-Type": "application/json"} for key in (ALICE, BOB))
            asked = [await http.post("/v1/chat/completions", headers=alice, **unfinished) for _ in range(2)]
            return asked, await http.post("/v1/chat/completions", headers=bob, **unfinished)

    (first, refused), of_bob = asyncio.run(run())
    assert [code(first), code(refused), code(of_bob)] == ["malformed-body", "rate-limited", "malformed-body"]
    assert f"allows {unit} per minute" in refused.json()["detail"]
    assert int(refused.headers["retry-after"]) >= 1


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


@pytest.mark.parametrize(
    ("client", "address"),
    [
        (("192.0.2.1", 7), "192.0.2.1"),
        (("fe80::1%eth0", 7), "fe80::/64"),
        (None, "unknown"),
        (("testclient", 1), "testclient"),
    ],
)
def test_addresses(client: tuple[str, int] | None, address: str) -> None:
    assert address_of({"client": client}) == address


# --- web pages ---

PAGE = "https://app.example.org"


@pytest.mark.parametrize("listed", [(), (PAGE,)])
def test_a_foreign_page_is_refused(tmp_path: Path, listed: tuple[str, ...]) -> None:
    origins = ("https://evil.example", "null", "http://cow:8001", "http://cow", "file://", "", PAGE + ".evil.example")
    asked = [("GET", "/models"), ("POST", "/simulate"), ("OPTIONS", "/simulate"), ("GET", "/livez"), ("GET", "/x")]
    preflight = {"Access-Control-Request-Method": "POST"}
    requests = [(method, path, {"Origin": origin} | preflight) for origin in origins for method, path in asked]
    for response in ask(app_of(tmp_path, cors_origins=listed), *requests):
        assert response.status_code == 403
        assert code(response) == "origin-not-allowed"
        assert "access-control-allow-origin" not in response.headers


def test_its_own_pages_may_use_the_server(tmp_path: Path) -> None:
    places = [
        ("http://cow:8000", "cow:8000"),
        ("http://COW:8000", "cow:8000"),
        ("http://localhost", "localhost:80"),
        ("https://localhost", "localhost"),
        ("http://127.0.0.1:8000", "127.0.0.1:8000"),
        ("http://[::1]:8000", "[::1]:8000"),
    ]
    for response in ask(app_of(tmp_path), *(("GET", "/livez", {"Origin": o, "Host": host}) for o, host in places)):
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
        ({}, (403, 200)),
        ({"cors_origins": (PAGE,)}, (403, 200)),
        ({"host": "0.0.0.0"}, (200, 200)),
        ({"api_keys": KEYS}, (200, 200)),
    ],
)
def test_a_page_cannot_rename_this_machine(tmp_path: Path, settings: dict, statuses: tuple[int, int]) -> None:
    app = app_of(tmp_path, **settings)
    foreign = ("evil.example:8000", "evil.example", "127.0.0.1.evil.example", "localhost.evil.example")
    local = ("localhost:8000", "cow.localhost", "127.0.0.1:8000", "[::1]:8000", "[::ffff:127.0.0.1]", "cow", "")
    if "cors_origins" in settings:
        local += ("app.example.org",)
    for hosts, status in zip((foreign, local), statuses, strict=True):
        for response in ask(app, *(("GET", "/livez", {"Host": host}) for host in hosts)):
            assert response.status_code == status
