"""`Client` and `AsyncClient` are the same: in names, signatures and sentences, and in what comes of calls."""

from __future__ import annotations

import hashlib
import inspect
import re
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, get_overloads

import numpy as np
import pytest
from conftest import EXAMPLES, Server
from PIL import Image
from sdk import KINDS, Connect
from servers import IMAGE, QUESTION, data_url

from cow_service import client as sdk
from cow_service.client import CowError
from hatch_build import CLIENT, TWINS, twin_of

PAIRS = [
    (sdk.Client, sdk.AsyncClient),
    (sdk.JobHandle, sdk.AsyncJobHandle),
    (sdk.Simulation, sdk.AsyncSimulation),
    (sdk.Answer, sdk.AsyncAnswer),
]
SPECIAL = {"__init__", "__enter__", "__exit__", "__aenter__", "__aexit__", "__repr__", "_repr_html_"}
PHOTO = EXAMPLES / "ball-and-mug" / "image.jpg"
ARROW = "If the yellow ball moves opposite to the direction of the arrow, will it hit the blue mug? (A) Yes (B) No"
RIGHT = "If the yellow ball moves to the left, will it hit the blue mug? (A) Yes (B) No"
SMALL: dict[str, Any] = {
    "grounding": {"point": [60, 80]},
    "motion": {"direction": [1, 0]},
    "num_frames": 5,
    "video": False,
    "frames": {"count": 1},
}


# --- names and signatures ---


@pytest.mark.parametrize("source", TWINS)
def test_the_blocking_twin_is_up_to_date(source: str) -> None:
    assert twin_of(CLIENT / source) == (CLIENT / TWINS[source]).read_text(), "install the package again"


def _members(kind: type) -> dict[str, Any]:
    """What a class of the SDK has of its own, by the name that its blocking twin would have."""
    found: dict[str, Any] = {}
    for base in reversed(kind.__mro__):
        if base.__module__.startswith("cow_service.client"):
            found |= {name: value for name, value in vars(base).items() if name in SPECIAL or not name.startswith("_")}
    found.pop("model_config", None)
    return {name.replace("__a", "__"): value for name, value in found.items()}


def _plain(text: Any) -> str:
    return re.sub(r"Async(?=[A-Z])|async_(?=client)", "", str(text)).replace("AsyncGenerator", "Generator")


def _function(member: Any) -> Any:
    return member.fget if isinstance(member, property) else member


def _signature(member: Any) -> list[tuple[str, Any, Any, str]]:
    told = inspect.signature(_function(member))
    return [
        (name, one.kind, one.default, _plain(one.annotation)) for name, one in told.parameters.items()
    ] + [("return", None, None, _plain(told.return_annotation))]  # fmt: skip


def _prose(member: Any) -> str:
    """A docstring without its examples."""
    text = inspect.getdoc(_function(member)) or ""
    return _plain("\n\n".join(part for part in text.split("\n\n") if not part.lstrip().startswith(">>>")))


@pytest.mark.parametrize(("blocking", "awaited"), PAIRS)
def test_both_have_the_same_members(blocking: type, awaited: type) -> None:
    assert set(_members(blocking)) == set(_members(awaited))


@pytest.mark.parametrize(
    ("blocking", "awaited", "name"),
    [
        (one, other, name)
        for one, other in PAIRS
        for name, member in _members(one).items()
        if callable(_function(member))
    ],
)
def test_both_take_and_say_the_same(blocking: type, awaited: type, name: str) -> None:
    one, other = _members(blocking)[name], _members(awaited)[name]
    assert isinstance(one, property) == isinstance(other, property)
    assert _signature(one) == _signature(other)
    assert [_signature(each) for each in get_overloads(_function(one))] == [
        _signature(each) for each in get_overloads(_function(other))
    ]
    assert _prose(one) == _prose(other)
    assert _prose(one) or name.startswith("_")


# --- what comes of calls ---


def _told(value: Any) -> Any:
    """An outcome without what differs between two that are the same."""
    if isinstance(value, list | tuple):
        return [_told(one) for one in value]
    if isinstance(value, dict):
        gone = ("id", "created_at", "finished_at", "timings", "reused")
        return {name: _told(one) for name, one in value.items() if name not in gone}
    if isinstance(value, np.ndarray):
        return value.shape, str(value.dtype), hashlib.sha256(value.tobytes()).hexdigest()
    if isinstance(value, Image.Image):
        return value.mode, value.size, hashlib.sha256(value.tobytes()).hexdigest()
    if isinstance(value, bytes):
        return hashlib.sha256(value).hexdigest()
    return _told(value.model_dump()) if hasattr(value, "model_dump") else value


def _everything_of(simulation: Any) -> list[Any]:
    return [
        simulation,
        simulation.pil_frames(),
        simulation.numpy_frames(),
        simulation.pil_overlay(),
        simulation.video_bytes() if simulation.video else None,
        simulation.load()._repr_html_(),
    ]


def _answer(client: Any) -> Any:
    answer = client.answer(PHOTO, ARROW).load()
    return [answer, answer._repr_html_(), _plain(repr(answer)).replace(answer.id, "")]


def _handle(client: Any) -> Any:
    handle = client.submit(IMAGE, QUESTION, **SMALL)
    events = [(one.name, one.number) for one in handle.events() if one.name != "progress"]
    found = client.job(handle.id)
    told = [
        handle.job.kind,
        handle.request(),
        events,
        handle.wait(),
        found.wait(timeout=1),
        found.refresh(),
        handle.cancel(),
    ]
    handle.delete()
    try:
        handle.refresh()
    except CowError as error:
        told.append(type(error).__name__)
    return told


def _listed(client: Any) -> Any:
    handle = client.submit(IMAGE, QUESTION, kind="answer", **{**SMALL, "options": ["Yes", "No"]})
    handle.wait()
    soon = datetime.now(UTC) + timedelta(hours=1)
    ids = [one.id for one in client.jobs(kind="answer", status=["succeeded"], created_before=soon)]
    return handle.id in ids, handle.id in [one.id for one in client.jobs(created_after=soon)]


def _saved(client: Any, folder: Path) -> Any:
    client.answer(PHOTO, RIGHT, video=True).save(folder)
    return sorted((path.name, path.suffix != ".json" and path.read_bytes()) for path in folder.iterdir())


SCENARIOS: dict[str, Callable[[Any], Any]] = {
    "simulate": lambda client: _everything_of(client.simulate(PHOTO, RIGHT, num_frames=17)),
    "simulate, without video": lambda client: _everything_of(client.simulate(IMAGE, QUESTION, **SMALL)),
    "simulate, with options": lambda client: client.simulate(
        data_url(IMAGE),
        QUESTION,
        **{
            **SMALL,
            "trajectory": {"points": np.array([[60, 80], [90, 80.5]])},
            "seed": np.int64(7),
            "fps": np.float32(8),
        },
    ),
    "simulate, waited for": lambda client: client.simulate(
        IMAGE, QUESTION, timeout=50, progress=lambda _: None, **SMALL
    ),
    "answer": _answer,
    "answer, plain": lambda client: client.answer(PHOTO, RIGHT, imagine="never", baseline=True, votes=2),
    "handle": _handle,
    "jobs": _listed,
    "artifact": lambda client: client.artifact(client.simulate(IMAGE, QUESTION, **SMALL).overlay.sha256),
    "models": lambda client: client.models(),
    "an object that is not there": lambda client: client.simulate(IMAGE, "If the pink car turns, what happens?"),
    "an option that is none": lambda client: client.simulate(IMAGE, QUESTION, num_frames=1, seconds=3),
    "a generator that is none": lambda client: client.submit(IMAGE, QUESTION, generator="crystal-ball"),
    "no image": lambda client: client.simulate(b"", QUESTION),
    "a file that is none": lambda client: client.simulate("/nowhere.png", QUESTION),
    "an object that is no image": lambda client: client.simulate(3, QUESTION),
    "no question": lambda client: client.answer(IMAGE, ""),
    "no job": lambda client: client.job("00000000-0000-0000-0000-000000000000"),
    "no artifact": lambda client: client.artifact("0" * 64),
    "a body too large": lambda client: client.simulate(bytes(4_000_000), QUESTION),
    "no video": lambda client: client.simulate(IMAGE, QUESTION, **SMALL).video_bytes(),
    "nothing to wait for": lambda client: client.jobs(status="runing"),
}


@pytest.fixture(scope="module")
def both(server: Server) -> Iterator[dict[str, Any]]:
    """A client of either kind, on one server."""
    made = {kind: Connect(kind) for kind in KINDS}
    yield {kind: connect(server.address) for kind, connect in made.items()}
    for connect in made.values():
        connect.close()


@pytest.mark.parametrize("name", SCENARIOS)
def test_both_come_to_the_same(both: dict[str, Any], name: str) -> None:
    outcomes = []
    for client in both.values():
        try:
            outcome: Any = _told(SCENARIOS[name](client))
            outcome = list(outcome) if isinstance(outcome, Iterator) else outcome
        except CowError as error:
            outcome = [type(error), error.code, error.status, error.detail, error.errors]
        except (OSError, ValueError) as error:
            outcome = [type(error), str(error)]
        outcomes.append(outcome)
    assert outcomes[0] == outcomes[1]
    assert outcomes[0]


def test_both_save_the_same(both: dict[str, Any], tmp_path: Path) -> None:
    one, other = (_saved(client, tmp_path / kind) for kind, client in both.items())
    assert one == other
    names = [name for name, _ in one]
    frames = [name for name in names if name.startswith("frame_")]
    assert len(frames) == 4
    assert names == [
        "answer.json",
        *frames,
        "overlay.jpg",
        "simulation.json",
        "video.mp4",
    ]
