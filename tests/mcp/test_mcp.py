"""The tools of the Model Context Protocol, asked by the protocol's own client over both transports."""

from __future__ import annotations

import base64
import io
import json
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import httpx
import pytest
from conftest import EXAMPLES, Server
from PIL import Image
from sdk import Scripted, told
from servers import data_url, picture
from waiting import TIME_LIMIT, eventually

from cow_service import __version__
from cow_service.api.middleware.access import hash_of, new_key
from cow_service.errors import install_line

if TYPE_CHECKING:
    from mcp_types import CallToolResult
    from sessions import Session

pytestmark = pytest.mark.slow
SCENE = EXAMPLES / "ball-and-mug" / "image.jpg"
SIZE = (832, 480)
MOVES = "If the yellow ball moves opposite to the direction of the arrow, will it hit the blue mug?"
QUESTION = f"{MOVES} (A) Yes (B) No (C) Not sure"
SLOWLY = {"image": str(SCENE), "question": MOVES, "generator": "lazy", "frames_count": 60}  # ended within a second
ALICE, BOB = new_key(), new_key()
KEYS = json.dumps({"alice": hash_of(ALICE), "bob": hash_of(BOB)})


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Session, Path]]:
    """Over stdio, with the service in the same process; keys and limits are for others."""
    from sessions import lazy, over_stdio

    folder = tmp_path_factory.mktemp("here")
    own = {"COW_DATA_DIR": str(folder / "data"), "COW_API_KEYS": KEYS, "COW_RATE_LIMIT": "1"}
    with over_stdio(folder, **own, **lazy(folder)) as session:
        yield session, folder


@pytest.fixture(scope="module")
def keyed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Over HTTP, with the service in the same process, which asks for keys."""
    from sessions import serving

    folder = tmp_path_factory.mktemp("keyed")
    with serving(folder, COW_DATA_DIR=str(folder / "data"), COW_API_KEYS=KEYS) as address:
        yield address


def text(result: CallToolResult) -> str:
    assert result.content[0].type == "text"
    return result.content[0].text


def failure(result: CallToolResult) -> str:
    """The error that a call ended with, as text."""
    assert result.is_error
    assert len(result.content) == 1
    assert "Traceback" not in text(result)
    return text(result)


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
    answer = session.data("answer", result)
    assert (answer["answer"], answer["option"], answer["not_sure"]) == ("A", "Yes", False)
    assert text(result).startswith("Answer: A (Yes).")
    assert sizes(result) == [SIZE, *[(512, 295)] * 4]
    return answer


def test_the_server_introduces_itself_and_its_tools(here: tuple[Session, Path]) -> None:
    session, _ = here
    assert session.client.server_info is not None
    assert (session.client.server_info.name, session.client.server_info.version) == ("cow", __version__)
    assert session.client.instructions
    tools = session.tools()
    assert list(tools) == ["simulate", "answer"]
    for tool in tools.values():
        assert tool.input_schema["required"] == ["image", "question"]
        assert all("description" in argument for argument in tool.input_schema["properties"].values())
        assert tool.description
        hints = tool.annotations
        assert hints is not None
        assert (hints.read_only_hint, hints.destructive_hint, hints.idempotent_hint, hints.open_world_hint) == (
            *(True, False),
            *(True, True),
        )
    [template] = session.portal.call(session.client.list_resource_templates).resource_templates
    assert template.uri_template == "cow://artifacts/{sha256}"
    assert session.portal.call(session.client.list_resources).resources == []


def test_simulate_over_stdio_returns_pictures_words_and_data(here: tuple[Session, Path]) -> None:
    session, _ = here
    result = session.call("simulate", image=str(SCENE), question=MOVES, video=True)
    simulation = session.data("simulate", result)
    assert simulation["grounding"]["object"] == "yellow ball"
    assert simulation["motion"]["kind"] == "linear"
    assert simulation["motion"]["direction"] == pytest.approx([0.98, 0.18], abs=0.02)
    last = simulation["trajectory"]["encounters"][-1]
    assert (last["object"], last["kind"]) == ("blue mug", "touches")
    assert all(contact["time"] > 0 for contact in simulation["trajectory"]["contacts"])
    assert (simulation["image"]["width"], simulation["image"]["height"]) == SIZE
    assert len(json.dumps(simulation)) < 4000
    assert sizes(result) == [SIZE, *((frame["width"], frame["height"]) for frame in simulation["frames"])]
    for said in ("yellow ball", f"hits blue mug after {last['time']:.1f} s", simulation["image"]["sha256"]):
        assert said in text(result)
    begun = [told[1:] for told in session.told if told[2] != "queued"]  # a wait for its turn is reported first
    assert begun[0] == (1.0, "grounding")
    assert session.told[-1] == (1.0, 1.0, "succeeded")
    done = [told[0] for told in session.told]
    assert done == sorted(set(done))
    assert done[0] < 0.001
    # Addresses of a service in this process cannot be opened: the protocol itself brings the video.
    assert simulation["video"]["url"].startswith("cow://artifacts/")
    assert simulation["video"]["url"] in text(result)
    [video] = session.portal.call(session.client.read_resource, simulation["video"]["url"]).contents
    assert video.mime_type == "video/mp4"
    assert base64.b64decode(video.blob)[4:8] == b"ftyp"


def test_agents_that_start_one_each_do_not_wait_for_one_another(here: tuple[Session, Path], tmp_path: Path) -> None:
    """A data folder is of one process: the others have folders in it."""
    from sessions import lazy, over_stdio

    _, folder = here
    with over_stdio(tmp_path, COW_DATA_DIR=str(folder / "data"), **lazy(tmp_path)) as second:
        simulation = second.data("simulate", second.call("simulate", image=str(SCENE), question=MOVES))
        assert simulation["grounding"]["object"] == "yellow ball"
        assert (folder / "data" / "beside-2" / "jobs.sqlite3").exists()


def test_answer_over_stdio_and_the_same_image_again(here: tuple[Session, Path]) -> None:
    session, _ = here
    answer = checked_answer(session, str(SCENE), votes=2, baseline=True)
    assert answer["baseline"]["answer"] == "C"
    again = checked_answer(session, answer["image"]["sha256"], options=json.dumps(["Yes", "No"]))
    assert again["image"]["sha256"] == answer["image"]["sha256"]
    assert again["simulation"]["trajectory"] == answer["simulation"]["trajectory"]


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"question": "What if the purple cow jumps?"}, ("cannot-ground: ", "`bbox` [x0, y0, x1, y1]", "request id")),
        (
            {"image": data_url(picture()), "question": "If the red ball moves forward, where does it stop?"},
            ("cannot-read-direction: ", "`direction` [dx, dy]"),
        ),
        ({"image": "https://example.org/a.png"}, ("image-url-not-allowed: ", "COW_ALLOW_IMAGE_URLS")),
        ({"bbox": [1, 2, 3]}, ("invalid-request: ", "- bbox/3: ")),
        ({"generator": "nobody"}, ("invalid-request: ", "- generator: ")),
    ],
)
def test_errors_say_how_to_do_better(
    here: tuple[Session, Path], arguments: dict[str, Any], told: tuple[str, ...]
) -> None:
    said = failure(here[0].call("simulate", **{"image": str(SCENE), "question": MOVES, **arguments}))
    assert said.startswith(told[0])
    assert all(part in said for part in told)


def test_unknown_tools_and_resources_are_errors_of_the_protocol(here: tuple[Session, Path]) -> None:
    from mcp import MCPError
    from mcp_types import INVALID_PARAMS

    session, _ = here
    read = partial(session.portal.call, session.client.read_resource)
    artifacts = [partial(read, f"cow://artifacts/{name}") for name in ("..%2Fjobs", "0" * 64)]
    for wrong in (partial(session.call, "imagine"), *artifacts):
        with pytest.raises(MCPError) as caught:
            wrong()
        assert caught.value.error.code == INVALID_PARAMS


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


def test_before_a_server_that_runs(tmp_path: Path, server: Server) -> None:
    """By the protocol's handshake of earlier versions."""
    from sessions import over_stdio

    address = server.address
    with over_stdio(tmp_path, "--url", address, mode="legacy") as there:
        result = there.call("answer", image=str(SCENE), question=QUESTION)
        answer = there.data("answer", result)
        assert there.told
        assert httpx.get(f"{address}/jobs/{answer['id']}", timeout=TIME_LIMIT).json()["kind"] == "answer"
        simulation = there.data("simulate", there.call("simulate", image=str(SCENE), question=MOVES, video=True))
        assert httpx.get(simulation["video"]["url"], timeout=TIME_LIMIT).headers["content-type"] == "video/mp4"


def test_over_http_the_caller_has_the_key_and_no_file_is_read(keyed: str) -> None:
    from sessions import over_http

    image = data_url(SCENE.read_bytes())
    with over_http(keyed, ALICE) as alice:
        answer = checked_answer(alice, image)
        assert alice.told[-1] == (1.0, 1.0, "succeeded")
        for path in (str(SCENE), SCENE.as_uri(), ""):
            said = failure(alice.call("simulate", image=path, question=MOVES))
            assert said.startswith("invalid-request: ")
            assert "- image: " in said
    with over_http(keyed, BOB, mode="legacy") as bob:  # what is Alice's is hers
        said = failure(bob.call("simulate", image=answer["image"]["sha256"], question=MOVES))
        assert said.startswith("artifact-not-found")
        assert checked_answer(bob, image)["id"] != answer["id"]
    for key in (None, "cow_nobodys", "not a key"):
        with over_http(keyed, key) as stranger:
            assert list(stranger.tools()) == ["simulate", "answer"]
            assert failure(stranger.call("answer", image=image, question=QUESTION)).startswith("unauthorized")


def test_foreign_pages_and_names_are_refused(keyed: str) -> None:
    ping = {"jsonrpc": "2.0", "id": 1, "method": "ping"}
    accept = {"Accept": "application/json, text/event-stream"}
    port = keyed.rpartition(":")[2]

    def status(**headers: str) -> int:
        return httpx.post(f"{keyed}/mcp", json=ping, headers=accept | headers, timeout=TIME_LIMIT).status_code

    assert [status(Host=f"evil.example:{port}"), status(Origin="https://evil.example")] == [421, 403]
    assert {status(), status(Origin=keyed), status(Host=f"localhost:{port}")}.isdisjoint({421, 403})


def test_callers_from_elsewhere_bring_their_own_key(tmp_path: Path) -> None:
    from sessions import over_http, serving

    with (
        Scripted(told("unauthorized", 401)) as door,
        serving(tmp_path, "--host", "0.0.0.0", "--url", door.url, COW_API_KEY="ours") as address,
    ):
        for key in (None, BOB):
            with over_http(address, key) as session:
                result = session.call("answer", image=data_url(SCENE.read_bytes()), question=QUESTION)
                assert failure(result).startswith("unauthorized")
    assert [asked.headers["authorization"] for asked in door.asked] == [f"Bearer {BOB}"]
    assert "Anyone who can reach 0.0.0.0" in (tmp_path / "log").read_text()


def test_it_ends_with_standard_input_or_by_a_signal_after_which_its_job_goes_on_at_the_next_start(
    tmp_path: Path,
) -> None:
    from sessions import Raw

    folders = [tmp_path / name for name in ("closed", "stopped")]
    with Raw(folders[0]) as closed, Raw(folders[1]) as stopped:  # begun together: their imports take seconds
        closed.begin(**SLOWLY)
        ends = [closed.ended()]
        stopped.begin(**SLOWLY)
        stopped.process.send_signal(signal.SIGTERM)
        stopped.process.wait(TIME_LIMIT)  # with standard input still open
        ends.append(stopped.ended())
    assert [code for code, _ in ends] == [0, 0], ends
    assert not any("Traceback" in log for _, log in ends)
    assert [statuses(folder) for folder in folders] == [["canceled"], ["queued"]]


def test_without_the_protocols_package_it_says_what_to_install(tmp_path: Path) -> None:
    from sessions import environment

    program = "import sys; sys.modules['mcp'] = None; from cow_service.cli.main import app; app(['mcp'])"
    own = environment(COW_DATA_DIR=str(tmp_path))
    result = subprocess.run([sys.executable, "-c", program], env=own, capture_output=True, text=True, check=False)
    assert result.returncode == 1, result.stderr
    assert install_line("mcp") in result.stderr
    assert not result.stdout
    assert "Traceback" not in result.stderr
