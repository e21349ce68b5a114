"""`Client` and `AsyncClient` have the same names and signatures. Here the second is asked, elsewhere the first."""

from __future__ import annotations

import asyncio
import inspect
import re
from pathlib import Path
from typing import Any, get_overloads

import pytest
from conftest import EXAMPLES
from refusals import refused
from sdk import address, served
from servers import BODY, IMAGE, QUESTION, Served

from cow_service import client as sdk
from cow_service.client import AsyncClient
from hatch_build import CLIENT, OPTIONS, TWINS, options_text, twin_of

__all__ = ["address", "served"]  # fixtures

PAIRS = [
    (sdk.Client, sdk.AsyncClient),
    (sdk.JobHandle, sdk.AsyncJobHandle),
    (sdk.Simulation, sdk.AsyncSimulation),
    (sdk.Answer, sdk.AsyncAnswer),
]
PHOTO = EXAMPLES / "ball-and-mug" / "image.jpg"
ASKED = "If the yellow ball moves to the left, will it hit the blue mug? (A) Yes (B) No"
SMALL = {name: value for name, value in BODY.items() if name not in ("image", "question")}


@pytest.mark.parametrize("source", TWINS)
def test_the_blocking_twin_is_up_to_date(source: str) -> None:
    assert twin_of(CLIENT / source) == (CLIENT / TWINS[source]).read_text(), "install the package again"
    assert options_text() == (CLIENT / OPTIONS).read_text(), "install the package again"


def _signature(member: Any) -> str:
    """As that of the blocking twin would be, types by name alone: pydantic tells those of records in several ways."""
    names = re.sub(r"['\"]|\b(?:\w+\.)+(?=[A-Z])", "", str(inspect.signature(member)))
    return re.sub(r"Async(?=[A-Z])", "", names).replace("async_", "sync_")


def _members(kind: type) -> dict[str, Any]:
    """What a class of the SDK has of its own and how it is called, by name."""
    found: dict[str, Any] = {}
    for name, value in inspect.getmembers(kind):
        member = value.fget if isinstance(value, property) else value
        ours = str(getattr(member, "__module__", "")).startswith("cow_service.client")
        if callable(member) and ours and not name.startswith("_"):
            overloads = [_signature(each) for each in get_overloads(member)]
            found[name] = (isinstance(value, property), _signature(member), overloads)
    return found


@pytest.mark.parametrize(("blocking", "awaited"), PAIRS)
def test_both_have_the_same_members_with_the_same_signatures(blocking: type, awaited: type) -> None:
    assert _members(blocking) == _members(awaited) != {}
    assert _signature(blocking) == _signature(awaited)


@pytest.mark.slow
def test_an_async_client_asks_a_real_server(address: str, tmp_path: Path) -> None:
    async def ask() -> None:
        async with AsyncClient(address) as client:
            answer = await client.answer(PHOTO, ASKED, video=True)
            assert answer.option == "No"
            assert answer._repr_html_().count("not downloaded") == 6  # a notebook cannot wait for it
            await answer.save(tmp_path)
            assert answer._repr_html_().count("not downloaded") == 0
            assert (await answer.simulation.numpy_frames()).shape == (4, 295, 512, 3)
            handle = await client.submit(IMAGE, QUESTION, **SMALL)
            assert [one.name async for one in handle.events()][-1] == "succeeded"
            assert (await (await client.job(handle.id)).wait()).frames
            assert handle.id in [one.id async for one in client.jobs(status="succeeded")]
            await handle.delete()
            with refused("job-not-found"):
                await handle.refresh()
            with refused("image-unreadable"):
                await client.simulate(b"", QUESTION)
        with refused("server-unreachable"):
            await client.models()

    asyncio.run(ask())
    assert {path.name for path in tmp_path.iterdir()} >= {"answer.json", "simulation.json", "overlay.jpg", "video.mp4"}


@pytest.mark.slow
def test_a_caller_who_leaves_a_wait_leaves_the_job(served: Served, address: str) -> None:
    async def ask() -> str:
        async with AsyncClient(address) as client:
            handle = await client.submit(IMAGE, QUESTION, **SMALL, fresh=True)
            task = asyncio.create_task(handle.wait())
            await asyncio.sleep(0)
            task.cancel()
            return (await handle.wait()).id

    assert served.job(asyncio.run(ask()))["status"] == "succeeded"
