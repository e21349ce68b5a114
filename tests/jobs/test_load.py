"""Many requests at the same time: every picture goes with its own question, and every answer to its own caller."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import mllm_server as say
import numpy as np
import pytest
from conftest import SCALE
from engines import app_for
from mllm_server import MllmServer
from numpy.typing import NDArray
from servers import data_url
from waiting import TIME_LIMIT

from cow_service.media.images import encode_png
from cow_service.service import Service
from cow_service.settings import Settings

pytestmark = [pytest.mark.slow, pytest.mark.scaled]

REQUESTS = 24 * SCALE
BITS = 12
WIDTH, HEIGHT = 16 * BITS, 96


def picture(number: int) -> str:
    """A number as black and white bars."""
    bars = [255 * (number >> bit & 1) for bit in range(BITS)]
    row = np.repeat(np.array(bars, np.uint8), WIDTH // BITS)
    return data_url(encode_png(np.repeat(np.tile(row, (HEIGHT, 1))[..., None], 3, axis=2)))


def number_in(pixels: NDArray[np.uint8]) -> int:
    """The number that a picture shows, whatever its size."""
    bars = np.array_split(pixels[pixels.shape[0] // 2, :, 0], BITS)
    return sum(int(bar[len(bar) // 2] > 127) << bit for bit, bar in enumerate(bars))


class Witness:
    """A multimodal LLM that answers with the number in its picture, and notes where the question means another."""

    def __init__(self, server: MllmServer) -> None:
        self.wrong: list[tuple[int, list[int]]] = []
        server.say(self.reply)

    def reply(self, handler: Any) -> None:
        asked = int(re.findall(r"picture (\d+)", say.text_of(handler.body))[-1])
        seen = [number_in(pixels) for pixels in say.images_of(handler.body)]
        if seen != [asked]:
            self.wrong.append((asked, seen))
        handler.send(200, say.completion(f'{{"reasoning": "", "answer": "{seen[0]}"}}'))


def connected(service: Service) -> httpx.AsyncClient:
    return httpx.AsyncClient(transport=httpx.ASGITransport(app_for(service)), base_url="http://cow", timeout=TIME_LIMIT)


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[Service, Witness]]:
    with say.mllm_server() as server:
        settings = Settings(data_dir=tmp_path, mllm="qwen3-vl-8b", mllm_base_url=server.address, queue_limit=10_000)
        with Service(settings) as service:
            yield service, Witness(server)


def body(number: int, **others: Any) -> dict[str, Any]:
    return {"image": picture(number), "question": f"What is in picture {number}?", "imagine": "never", **others}


def test_no_request_gets_the_picture_or_the_answer_of_another(served: tuple[Service, Witness]) -> None:
    service, witness = served

    async def ask(client: httpx.AsyncClient, number: int) -> tuple[int, Any]:
        """In the ways in which a job's image can get to it: at once or from the queue, alone, in votes, again."""
        way = number % 4
        headers = {"Cache-Control": "no-cache"} if way == 1 else {}
        if way == 2:
            # The key comes with another picture, whose job is deleted, and then with this one.
            headers = {"Idempotency-Key": f"key-{number}"}
            first = await client.post(
                "/answer", json=body(number + REQUESTS), headers=headers | {"Prefer": "respond-async"}
            )
            assert (await client.delete(f"/jobs/{first.json()['id']}")).status_code == 204
        told = await client.post("/answer", json=body(number, votes=3 if way == 3 else 1), headers=headers)
        assert told.status_code == 200, told.text
        again = await client.post("/answer", json=body(number, votes=3 if way == 3 else 1))
        assert again.json()["answer"] == told.json()["answer"]
        return number, told.json()["answer"]

    async def all_at_once() -> list[tuple[int, Any]]:
        async with connected(service) as client:
            return await asyncio.gather(*(ask(client, number) for number in range(REQUESTS)))

    assert asyncio.run(all_at_once()) == [(number, str(number)) for number in range(REQUESTS)]
    assert witness.wrong == []
