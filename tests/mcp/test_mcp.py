"""The tools of the Model Context Protocol, asked by the protocol's own client over both transports."""

from __future__ import annotations

import base64
import io
import json
import os
import signal
import sqlite3
import subprocess
import sys
import threading
from collections.abc import AsyncGenerator, Iterator
from concurrent.futures import Future
from contextlib import AbstractAsyncContextManager, asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import anyio
import httpx
import httpx2
import numpy as np
import pytest
from anyio.from_thread import BlockingPortal, start_blocking_portal
from conftest import EXAMPLES, Server
from jsonschema import Draft202012Validator
from mcp import Client, MCPError, StdioServerParameters
from mcp.client.stdio import stdio_client
from mcp.client.streamable_http import streamable_http_client
from mcp_types import CallToolResult, Tool
from PIL import Image
from servers import SLOW_GENERATOR, data_url, picture
from waiting import eventually

from cow_service import __version__
from cow_service.api.middleware.access import hash_of, new_key
from cow_service.client import AsyncClient, CowError
from cow_service.client.errors import CannotGround
from cow_service.errors import FieldError, InvalidRequest, Unauthorized, install_line
from cow_service.mcp.arguments import REMEDIES, error_text, image_of, request_fields
from cow_service.mcp.results import MAX_BYTES, fit_pictures
from cow_service.mcp.server import Caller
from cow_service.mcp.serving import backend_for, for_its_owner, protection, with_own_keys
from cow_service.media.images import encode_jpeg
from cow_service.requests import ImageArtifact
from cow_service.settings import Settings, SettingsError

pytestmark = pytest.mark.slow
SCENE = EXAMPLES / "ball-and-mug" / "image.jpg"
SIZE = (832, 480)
MOVES = "If the yellow ball moves opposite to the direction of the arrow, will it hit the blue mug?"
QUESTION = f"{MOVES} (A) Yes (B) No (C) Not sure"
COMMAND = [sys.executable, "-m", "cow_service.cli.main", "mcp"]
ALICE, BOB = new_key(), new_key()
KEYS = json.dumps({"alice": hash_of(ALICE), "bob": hash_of(BOB)})


# The slow generator of the job tests, slow without being told: the tools take no options of generators.
LAZY = """
from slow_generator import SlowGenerator, SlowOptions


class LazyOptions(SlowOptions):
    seconds: float = 60


class LazyGenerator(SlowGenerator):
    options_model = LazyOptions


def create(settings):
    return LazyGenerator()
"""
SLOWLY = {"image": str(SCENE), "question": MOVES, "generator": "lazy", "frames_count": 60}  # ended within a second


def lazy(folder: Path) -> dict[str, str]:
    """Settings with which the generator `lazy` is installed."""
    known = folder / "lazy-1.0.dist-info"
    known.mkdir()
    (known / "METADATA").write_text("Metadata-Version: 2.1\nName: lazy\nVersion: 1.0\n")
    (known / "entry_points.txt").write_text("[cow_service.generators]\nlazy = lazy_generator:create\n")
    (folder / "lazy_generator.py").write_text(LAZY)
    return {"PYTHONPATH": os.pathsep.join((str(SLOW_GENERATOR), str(folder)))}


def environment(**settings: str) -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if not name.startswith("COW_")} | settings


@dataclass
class Session:
    """A client of the protocol, connected, for tests that wait."""

    portal: BlockingPortal
    client: Client
    told: list[tuple[float, float | None, str | None]] = field(default_factory=list)

    def tools(self) -> dict[str, Tool]:
        return {tool.name: tool for tool in self.portal.call(self.client.list_tools).tools}

    def call(self, tool: str, **arguments: Any) -> CallToolResult:
        return self.portal.call(self._call, tool, arguments)

    def start(self, tool: str, **arguments: Any) -> Future[CallToolResult]:
        return self.portal.start_task_soon(self._call, tool, arguments)

    async def _call(self, tool: str, arguments: dict[str, Any]) -> CallToolResult:
        self.told.clear()
        result = await self.client.call_tool(tool, arguments, progress_callback=self._hear)
        assert isinstance(result, CallToolResult)
        return result

    async def _hear(self, done: float, total: float | None, doing: str | None) -> None:
        self.told.append((done, total, doing))


@contextmanager
def connected(transport: AbstractAsyncContextManager[Any], mode: str = "auto") -> Iterator[Session]:
    with (
        start_blocking_portal() as portal,
        portal.wrap_async_context_manager(Client(transport, mode=mode)) as client,
    ):
        yield Session(portal, client)


@contextmanager
def over_stdio(folder: Path, *options: str, mode: str = "auto", **settings: str) -> Iterator[Session]:
    command = StdioServerParameters(
        command=COMMAND[0], args=[*COMMAND[1:], *options], env=environment(**settings), cwd=folder
    )
    with (folder / "log").open("w") as log, connected(stdio_client(command, errlog=log), mode) as session:
        yield session
    assert "Traceback" not in (folder / "log").read_text()


@contextmanager
def over_http(address: str, key: str | None = None, mode: str = "auto") -> Iterator[Session]:
    @asynccontextmanager
    async def transport() -> AsyncGenerator[Any]:
        headers = {} if key is None else {"Authorization": f"Bearer {key}"}
        async with (
            httpx2.AsyncClient(headers=headers, timeout=60) as http,
            streamable_http_client(f"{address}/mcp", http_client=http) as streams,
        ):
            yield streams

    with connected(transport(), mode) as session:
        yield session


@contextmanager
def serving(folder: Path, *options: str, **settings: str) -> Iterator[str]:
    """`cow mcp` over HTTP in its own process, at this address."""
    command = [*COMMAND, "--transport", "http", "--port", "0", *options]
    log = folder / "log"
    with log.open("w") as err:
        process = subprocess.Popen(command, env=environment(**settings), stdout=subprocess.PIPE, stderr=err)

    def port() -> str | None:
        assert process.poll() is None, log.read_text()
        _, _, told = log.read_text().partition("running on http://")
        return told.partition(" ")[0].rpartition(":")[2] if " " in told else None

    try:
        yield f"http://127.0.0.1:{eventually(port)}"
        process.terminate()
        out, _ = process.communicate(timeout=30)
        assert not out
        assert process.returncode == -signal.SIGTERM  # after a stop in peace
        assert "Traceback" not in log.read_text()
    finally:
        process.kill()
        process.wait()


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Session, Path]]:
    """Over stdio, with the service in the same process; keys and limits are for others."""
    folder = tmp_path_factory.mktemp("here")
    own = {"COW_DATA_DIR": str(folder / "data"), "COW_API_KEYS": KEYS, "COW_RATE_LIMIT": "1"}
    with over_stdio(folder, **own, **lazy(folder)) as session:
        yield session, folder


@pytest.fixture(scope="module")
def there(tmp_path_factory: pytest.TempPathFactory, server: Server) -> Iterator[Session]:
    """Over stdio, before a server that runs; by the protocol's handshake of earlier versions."""
    with over_stdio(tmp_path_factory.mktemp("there"), "--url", server.address, mode="legacy") as session:
        yield session


@pytest.fixture(scope="module")
def keyed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Over HTTP, with the service in the same process, which asks for keys."""
    folder = tmp_path_factory.mktemp("keyed")
    with serving(folder, COW_DATA_DIR=str(folder / "data"), COW_API_KEYS=KEYS) as address:
        yield address


@pytest.fixture(scope="module")
def alice(keyed: str) -> Iterator[Session]:
    with over_http(keyed, ALICE) as session:
        yield session


def text(result: CallToolResult) -> str:
    assert result.content[0].type == "text"
    return result.content[0].text


def failure(result: CallToolResult) -> str:
    assert result.is_error
    assert len(result.content) == 1
    told = text(result)
    assert "Traceback" not in told
    return told


def data(session: Session, tool: str, result: CallToolResult) -> dict[str, Any]:
    """The structured content, which is as the tool declares it."""
    assert not result.is_error, text(result)
    schema = session.tools()[tool].output_schema
    assert schema is not None
    Draft202012Validator.check_schema(schema)
    Draft202012Validator(schema).validate(result.structured_content)
    return result.structured_content


def sizes(result: CallToolResult) -> list[tuple[int, int]]:
    """Sizes of the pictures, in order."""
    found = []
    for place, block in enumerate(result.content[1:]):
        assert block.type == "image"
        kind = "PNG" if place else "JPEG"  # the overlay comes first
        assert block.mime_type == f"image/{kind.lower()}"
        with Image.open(io.BytesIO(base64.b64decode(block.data))) as picture:
            picture.load()
            assert picture.format == kind
            found.append(picture.size)
    return found


def checked_answer(session: Session, image: str, **more: Any) -> dict[str, Any]:
    result = session.call("answer", image=image, question=QUESTION, **more)
    answer = data(session, "answer", result)
    assert (answer["answer"], answer["option"], answer["not_sure"]) == ("A", "Yes", False)
    assert text(result).startswith("Answer: A (Yes).")
    assert sizes(result) == [SIZE, *[(512, 295)] * 4]
    return answer


def test_the_server_introduces_itself_and_its_tools(here: tuple[Session, Path]) -> None:
    session, _ = here
    assert session.client.server_info is not None
    assert (session.client.server_info.name, session.client.server_info.version) == ("cow", __version__)
    assert "what-if" in (session.client.instructions or "")
    tools = session.tools()
    assert list(tools) == ["simulate", "answer"]
    for tool in tools.values():
        Draft202012Validator.check_schema(tool.input_schema)
        assert tool.input_schema["required"] == ["image", "question"]
        assert all("description" in argument for argument in tool.input_schema["properties"].values())
        assert "path" in tool.input_schema["properties"]["image"]["description"]
        assert "hypotheses with probabilities" in (tool.description or "")
        assert tool.annotations is not None
        assert tool.annotations.read_only_hint
        assert not tool.annotations.destructive_hint
    given = {"image", "question", "object", "bbox", "point", "direction", "motion_kind", "speed", "num_frames", "seed"}
    given |= {"distance", "duration", "until", "remove", "place"}
    given |= {"asked", "law", "objects", "frames_policy", "frames_count", "generator", "reader"}
    assert set(tools["simulate"].input_schema["properties"]) == given | {"video"}
    assert set(tools["answer"].input_schema["properties"]) == given | {
        "options", "votes", "baseline", "imagine", "imagine_votes", "imagine_threshold"
    }  # fmt: skip


def test_simulate_over_stdio_returns_pictures_words_and_data(here: tuple[Session, Path]) -> None:
    session, _ = here
    result = session.call("simulate", image=str(SCENE), question=MOVES, video=True)
    simulation = data(session, "simulate", result)
    assert simulation["grounding"]["object"] == "yellow ball"
    assert simulation["motion"]["kind"] == "linear"
    assert simulation["motion"]["direction"] == pytest.approx([0.98, 0.18], abs=0.02)
    last = simulation["trajectory"]["encounters"][-1]
    assert (last["object"], last["kind"]) == ("blue mug", "touches")
    assert (simulation["image"]["width"], simulation["image"]["height"]) == SIZE
    assert len(json.dumps(simulation)) < 4000
    assert sizes(result) == [SIZE, *((frame["width"], frame["height"]) for frame in simulation["frames"])]
    for told in (
        "yellow ball",
        f"hits blue mug after {last['time']:.1f} s",
        simulation["image"]["sha256"],
    ):
        assert told in text(result)
    begun = [told[1:] for told in session.told if told[2] != "queued"]  # a wait for its turn is reported first
    assert begun[0] == (1.0, "grounding")
    assert session.told[-1] == (1.0, 1.0, "succeeded")
    done = [told[0] for told in session.told]
    assert done == sorted(set(done))
    # Addresses of a service in this process cannot be opened: the protocol itself brings the video.
    assert simulation["video"]["url"].startswith("cow://artifacts/")
    assert simulation["video"]["url"] in text(result)
    [video] = session.portal.call(session.client.read_resource, simulation["video"]["url"]).contents
    assert video.mime_type == "video/mp4"
    assert base64.b64decode(video.blob)[4:8] == b"ftyp"


def test_answer_over_stdio_and_the_same_image_again(here: tuple[Session, Path]) -> None:
    session, _ = here
    answer = checked_answer(session, str(SCENE), votes=2, baseline=True)
    assert answer["baseline"]["answer"] == "C"
    again = checked_answer(session, answer["image"]["sha256"], options=json.dumps(["Yes", "No"]))
    assert again["image"]["sha256"] == answer["image"]["sha256"]
    assert again["simulation"]["trajectory"] == answer["simulation"]["trajectory"]


def test_a_tool_takes_what_people_know_better(here: tuple[Session, Path]) -> None:
    session, _ = here
    result = session.call(
        "simulate",
        image=SCENE.as_uri(),
        question="Where does it go?",
        object="ball",
        bbox="[244, 194, 307, 257]",
        direction=[1, 0],
        motion_kind="projectile",
        speed=100,
        num_frames=17,
        frames_policy="uniform",
        frames_count=2,
        seed=7,
        generator="cutout",
        reader=None,
    )
    simulation = data(session, "simulate", result)
    motion = simulation["motion"]
    assert (simulation["grounding"]["object"], motion["kind"], motion["speed"]) == ("ball", "projectile", 100)
    assert [frame["index"] for frame in simulation["frames"]] == [0, 16]
    assert len(sizes(result)) == 3


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"question": "What if the purple cow jumps?"}, ("cannot-ground", "purple cow", "`bbox` [x0, y0, x1, y1]")),
        (
            {"image": data_url(picture()), "question": "Where does the red ball go?"},
            ("cannot-read-direction", "`direction` [dx, dy]"),
        ),
        ({"image": "nowhere.png"}, ("invalid-request", "image: there is no file", "absolute path")),
        ({"image": __file__}, ("invalid-request", "is not a PNG, JPEG or WebP file")),
        ({"image": "0" * 64}, ("artifact-not-found", "Send the image itself")),
        ({"image": "https://example.org/a.png"}, ("image-url-not-allowed", "COW_ALLOW_IMAGE_URLS")),
        ({"image": "data:image/png;base64,AAAA"}, ("image-type-unsupported", "image")),
        ({"bbox": [1, 2, 3]}, ("invalid-request", "bbox/3: ")),
        ({"bbox": [9, 9, 9, 9]}, ("invalid-request", "bbox: [x0, y0, x1, y1] must have x1 and y1 at least 2 px")),
        ({"object": "ball"}, ("invalid-request", "give exactly one of `bbox`, `point` and `mask`")),
        ({"motion_kind": "projectile"}, ("invalid-request", "needs a `direction`")),
        ({"frames_count": 1000}, ("invalid-request", "frames_count: ")),
        ({"generator": "nobody"}, ("invalid-request", "generator: There is no generator 'nobody'", "cutout")),
        ({"bBox": [1, 2, 3, 4]}, ("invalid-request", "No argument of this tool: bBox", "bbox")),
        ({"grounding": {"point": [1, 2]}}, ("grounding (instead: `object`, `bbox`, `point`)",)),
        ({"question": 7}, ("invalid-request", "question: ")),
    ],
)
def test_errors_say_how_to_do_better(
    here: tuple[Session, Path], arguments: dict[str, Any], told: tuple[str, ...]
) -> None:
    result = here[0].call("simulate", **{"image": str(SCENE), "question": MOVES, **arguments})
    for part in told:
        assert part in failure(result)


def test_unknown_tools_and_resources_are_errors_of_the_protocol(here: tuple[Session, Path]) -> None:
    session, _ = here
    with pytest.raises(MCPError, match="Unknown tool"):
        session.call("imagine")
    for uri, told in (("cow://artifacts/..%2Fjobs", "no resource"), (f"cow://artifacts/{'0' * 64}", "artifact")):
        with pytest.raises(MCPError, match=told):
            session.portal.call(session.client.read_resource, uri)


def statuses(folder: Path) -> list[str]:
    """Of the jobs in a data folder, oldest first."""
    with sqlite3.connect(folder / "data" / "jobs.sqlite3") as database:
        found = database.execute("SELECT status FROM cow_jobs ORDER BY created_at, rowid").fetchall()
    database.close()
    return [status for (status,) in found]


def test_a_call_that_is_canceled_cancels_its_job(here: tuple[Session, Path]) -> None:
    session, folder = here
    call = session.start("simulate", **SLOWLY)
    eventually(lambda: [told for told in session.told if told[2] == "generation"])
    call.cancel()  # else it would take a minute
    eventually(lambda: statuses(folder)[-1] == "canceled")
    assert session.tools()


def test_before_a_server_that_runs(there: Session, server: Server) -> None:
    answer = checked_answer(there, data_url(SCENE.read_bytes()))
    assert there.told
    with httpx.Client(base_url=server.address) as http:
        assert http.get(f"/jobs/{answer['id']}").json()["kind"] == "answer"
    simulation = data(there, "simulate", there.call("simulate", image=str(SCENE), question=MOVES, video=True))
    assert httpx.get(simulation["video"]["url"]).headers["content-type"] == "video/mp4"


def test_over_http_the_caller_has_the_key(keyed: str, alice: Session) -> None:
    answer = checked_answer(alice, data_url(SCENE.read_bytes()))
    assert "(generation)" not in str(alice.told)
    assert alice.told[-1] == (1.0, 1.0, "succeeded")
    with over_http(keyed, BOB, mode="legacy") as bob:  # what is Alice's is hers
        told = failure(bob.call("simulate", image=answer["image"]["sha256"], question=MOVES))
        assert told.startswith("artifact-not-found")
        assert checked_answer(bob, data_url(SCENE.read_bytes()))["id"] != answer["id"]
        assert bob.told
    for key in (None, "cow_nobodys", "not a key"):
        with over_http(keyed, key) as stranger:
            assert list(stranger.tools()) == ["simulate", "answer"]
            told = failure(stranger.call("answer", image=data_url(SCENE.read_bytes()), question=QUESTION))
            assert told.startswith("unauthorized")
            assert "Bearer" in told


@pytest.mark.parametrize("image", [str(SCENE), SCENE.as_uri(), "~/image.jpg", "image.jpg", ""])
def test_over_http_no_file_is_read(alice: Session, image: str) -> None:
    told = failure(alice.call("simulate", image=image, question=MOVES))
    assert "this server reads no local files" in told


def test_foreign_pages_and_names_are_refused(keyed: str) -> None:
    ping = {"jsonrpc": "2.0", "id": 1, "method": "ping"}
    accept = {"Accept": "application/json, text/event-stream"}
    port = keyed.rpartition(":")[2]

    def status(**headers: str) -> int:
        return httpx.post(f"{keyed}/mcp", json=ping, headers=accept | headers).status_code

    refused = {status(Host=f"evil.example:{port}"), status(Origin="https://evil.example"), status(Origin="null")}
    assert refused == {421, 403}
    assert status() not in refused
    assert status(Origin=keyed) not in refused
    assert status(Host=f"localhost:{port}") not in refused


class Door(BaseHTTPRequestHandler):
    """A server that refuses everyone, and records the keys that were sent."""

    keys: list[str | None]

    def do_POST(self) -> None:
        self.keys.append(self.headers["Authorization"])
        self.rfile.read(int(self.headers["Content-Length"]))
        body = json.dumps({"type": "urn:cow:problem:unauthorized", "status": 401, "detail": "No."}).encode()
        self.send_response(401)
        self.send_header("Content-Type", "application/problem+json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: Any) -> None:
        pass


@pytest.mark.parametrize(
    "listening", [("--host", "0.0.0.0"), ("--allow-host", "cow.example.org")], ids=["an open address", "behind a proxy"]
)
def test_callers_from_elsewhere_bring_their_own_key(tmp_path: Path, listening: tuple[str, ...]) -> None:
    keys: list[str | None] = []
    door = ThreadingHTTPServer(("127.0.0.1", 0), type("_Door", (Door,), {"keys": keys}))
    threading.Thread(target=door.serve_forever).start()
    try:
        url = f"http://127.0.0.1:{door.server_port}"
        with serving(tmp_path, *listening, "--url", url, COW_API_KEY="ours") as address:
            for key in (None, BOB):
                with over_http(address, key) as session:
                    result = session.call("answer", image=data_url(SCENE.read_bytes()), question=QUESTION)
                    assert failure(result).startswith("unauthorized")
    finally:
        door.shutdown()
        door.server_close()
    assert keys == [f"Bearer {BOB}"]
    open_to_all = "0.0.0.0" in listening
    assert open_to_all == (
        "Anyone who can reach 0.0.0.0 can use the COW server behind it" in (tmp_path / "log").read_text()
    )


class Raw:
    """`cow mcp` over stdio, spoken to in lines, in a process group of its own."""

    def __init__(self, folder: Path) -> None:
        settings = {"COW_DATA_DIR": str(folder / "data"), "COW_LOG_LEVEL": "debug"}
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(
            COMMAND,
            env=environment(**settings, **lazy(folder)),
            stdin=pipe,
            stdout=pipe,
            stderr=pipe,
            start_new_session=True,
        )
        self.ids = iter(range(1, 100))
        hello = {"protocolVersion": "2025-06-18", "capabilities": {}, "clientInfo": {"name": "test", "version": "0"}}
        self.send("initialize", hello)
        assert self.read()["result"]["serverInfo"]["name"] == "cow"
        self.send("notifications/initialized", None)

    def __enter__(self) -> Raw:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.communicate()

    def send(self, method: str, params: dict[str, Any] | None) -> None:
        message = {"jsonrpc": "2.0", "method": method}
        message |= {} if params is None else {"id": next(self.ids), "params": params}
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(message).encode() + b"\n")
        self.process.stdin.flush()

    def read(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        return json.loads(self.process.stdout.readline())

    def begin_slowly(self) -> None:
        """A call whose clip is in the making."""
        meta = {"progressToken": "t"}
        self.send("tools/call", {"name": "simulate", "arguments": SLOWLY, "_meta": meta})
        while self.read()["params"]["message"] != "generation":
            pass

    def ended(self) -> tuple[int, str]:
        """Exit code and log; standard output has nothing else, and no process is left."""
        out, err = self.process.communicate(timeout=30)
        assert all(json.loads(line)["jsonrpc"] == "2.0" for line in out.splitlines())
        with pytest.raises(ProcessLookupError):
            os.killpg(self.process.pid, 0)
        return self.process.returncode, err.decode()


def test_it_ends_when_standard_input_does(tmp_path: Path) -> None:
    with Raw(tmp_path) as raw:
        raw.begin_slowly()
        code, log = raw.ended()
    assert code == 0, log
    assert "Traceback" not in log
    assert statuses(tmp_path) == ["canceled"]


def test_a_signal_ends_it_and_the_job_goes_on_at_the_next_start(tmp_path: Path) -> None:
    with Raw(tmp_path) as raw:
        raw.begin_slowly()
        raw.process.send_signal(signal.SIGTERM)
        raw.process.wait(30)  # with standard input still open
        code, log = raw.ended()
    assert code == 128 + signal.SIGTERM, log
    assert "Traceback" not in log
    assert statuses(tmp_path) == ["queued"]


@pytest.mark.parametrize(
    ("code", "options", "exit_code", "told"),
    [
        ("sys.modules['mcp'] = None", (), 1, install_line("mcp")),
        ("pass", ("--url", "ftp://x"), 2, "must begin with http:// or https://"),
    ],
)
def test_what_cannot_start_says_why(
    tmp_path: Path, code: str, options: tuple[str, ...], exit_code: int, told: str
) -> None:
    program = f"import sys; {code}; from cow_service.cli.main import app; app(['mcp', *sys.argv[1:]])"
    result = subprocess.run(
        [sys.executable, "-c", program, *options],
        env=environment(COW_DATA_DIR=str(tmp_path)),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == exit_code, result.stderr
    assert told in result.stderr
    assert not result.stdout
    assert "Traceback" not in result.stderr


def test_images_by_whatever_names_them(tmp_path: Path) -> None:
    digest = "ab" * 32
    for paths in (True, False):
        for name in (digest, digest.upper(), f" cow://artifacts/{digest}\n"):
            assert image_of(name, paths=paths) == ImageArtifact(artifact=digest)
        assert image_of("HTTPS://example.org/A.png", paths=paths) == "https://example.org/A.png"
        assert image_of("Data:image/png;base64,AA==", paths=paths) == "data:image/png;base64,AA=="
    odd = tmp_path / "a picture %41.jpg"
    odd.write_bytes(SCENE.read_bytes())
    assert image_of(str(odd), paths=True) == image_of(odd.as_uri(), paths=True) == SCENE.read_bytes()
    for name in ("/dev/zero", str(tmp_path), "ftp://x/a.png", "a\0b", "~nobody-of-that-name/a.png", "x" * 5000):
        with pytest.raises(InvalidRequest) as caught:
            image_of(name, paths=True)
        assert caught.value.errors[0].pointer == "/image"
        assert len(caught.value.errors[0].detail) < 400


def test_arguments_become_a_request() -> None:
    plain = {"image": "x", "question": "?"}
    assert request_fields("simulate", plain) == {**plain, "video": False}
    full = {
        "image": "x",
        "question": "?",
        "point": [1, 2],
        "object": "cup",
        "motion_kind": "fall",
        "options": '["a","b"]',
    }
    assert request_fields("answer", full) == {
        **plain,
        "grounding": {"object": "cup", "point": [1, 2]},
        "motion": {"kind": "fall"},
        "options": ["a", "b"],
    }


def test_large_pictures_are_made_fit_for_a_model() -> None:
    buffer = io.BytesIO()
    Image.new("RGB", (3000, 1500), "red").save(buffer, "PNG")
    ((media_type, shown),) = fit_pictures([buffer.getvalue()])
    assert media_type == "image/png"
    with Image.open(io.BytesIO(shown)) as small:
        assert small.size == (1024, 512)
    assert fit_pictures([shown]) == [("image/png", shown)]


def test_remedies_are_for_errors_that_there_are() -> None:
    known = {kind.code for kind in CowError.__subclasses__()} | {CannotGround.code, "object-not-found"}
    assert set(REMEDIES) <= known
    error = InvalidRequest("-", errors=(FieldError("/motion/kind", "wrong"), FieldError("", "none")))
    assert error_text(error).splitlines()[1:] == ["- motion_kind: wrong", "- arguments: none"]


def test_names_by_which_it_may_be_asked() -> None:
    security = protection("::", ["Cow.Example", "10.0.0.7:8443"])
    assert security.enable_dns_rebinding_protection
    assert {"localhost:*", "[::1]", "cow.example", "cow.example:*", "10.0.0.7:8443"} <= set(security.allowed_hosts)
    assert "::" not in security.allowed_hosts
    assert "https://cow.example" in security.allowed_origins
    assert "[fd00::1]:*" in protection("fd00::1", []).allowed_hosts


def test_our_own_key_is_not_lent_to_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COW_API_KEY", "ours")

    @asynccontextmanager
    async def way(_: Caller) -> AsyncGenerator[AsyncClient]:
        yield AsyncClient("http://cow")

    async def asked(caller: Caller, everybody: bool) -> None:
        async with with_own_keys(way, everybody=everybody)(caller) as client:
            await client.close()

    anyio.run(asked, Caller("theirs"), True)
    anyio.run(asked, Caller(), False)
    anyio.run(asked, Caller("theirs", forwarded=True), False)
    for caller, everybody in ((Caller(), True), (Caller(forwarded=True), False)):
        with pytest.raises(Unauthorized):
            anyio.run(asked, caller, everybody)


def test_a_server_of_ones_own_has_no_keys(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path, api_keys=json.loads(KEYS), cors_origins=("*",), host="0.0.0.0")
    own = for_its_owner(settings)
    assert (own.api_keys, own.cors_origins, own.host, own.data_dir) == ({}, (), "127.0.0.1", tmp_path)
    with pytest.raises(SettingsError, match="http"):
        backend_for(settings, "cow.example")


@pytest.mark.parametrize("count", [1, 12])
def test_pictures_of_photographs_fit_into_a_message(count: int) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (600, 1400, 3), np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(noise).save(buffer, "PNG")
    shown = fit_pictures([buffer.getvalue()] * count)
    assert len(shown) == count
    assert sum(len(data) for _, data in shown) <= MAX_BYTES
    sizes = {Image.open(io.BytesIO(data)).size for _, data in shown}
    assert len(sizes) == 1
    assert max(sizes.pop()) <= 1024
    assert {media_type for media_type, _ in shown} == {"image/jpeg"}


def test_small_pictures_stay_as_they_are() -> None:
    buffer = io.BytesIO()
    Image.new("RGB", (300, 200), "red").save(buffer, "PNG")
    overlay = encode_jpeg(np.zeros((200, 300, 3), np.uint8))
    assert fit_pictures([overlay, buffer.getvalue()]) == [("image/jpeg", overlay), ("image/png", buffer.getvalue())]
