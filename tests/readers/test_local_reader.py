"""From grounding to answer with a real Qwen3-VL at toy size: in this process, and in a second one over HTTP.

Its weights are random: what it says means nothing, but every word goes the way that a large model's would.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator

import httpx
import pytest
from conftest import SCALE, TESTS, example

from cow_service.errors import CowError
from cow_service.records import Answer
from cow_service.requests import AnswerRequest
from cow_service.service import Service
from cow_service.settings import Settings

pytest.importorskip("torch")
pytestmark = pytest.mark.slow
TYPED = {"object-not-found", "mllm-bad-reply", "cannot-read-direction"}


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    data = tmp_path_factory.mktemp("local")
    with Service(Settings(data_dir=data, mllm="tiny-qwen3-vl", reader="local", device="cpu")) as service:
        yield service


@pytest.fixture(scope="module")
def remote(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """COW in this process, the model in another."""
    data = tmp_path_factory.mktemp("remote")
    command = [sys.executable, str(TESTS / "serve_toy.py")]
    environment = os.environ | {"PYTHONWARNINGS": "ignore"}
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        address = process.stdout.readline().strip()
        settings = Settings(data_dir=data, mllm="tiny-qwen3-vl", mllm_base_url=address)
        assert settings.reader == "mllm"
        with Service(settings) as service:
            yield service
        process.kill()


def answers(service: Service) -> list[Answer]:
    """Answers for several seeds, until one imagined: random words may name nothing, or a place without area."""
    scene = example("ball-and-mug")
    image = service.keep_image(scene.image)
    body = {"image": {"artifact": image.sha256}, "question": scene.meta["question"], "video": False, "num_frames": 9}
    found: list[Answer] = []
    for seed in range(1, 12):
        found.append(service.answer(AnswerRequest.model_validate(body | {"seed": seed, "votes": 2})))
        if len(found) > 1 and any(answer.simulation is not None for answer in found):
            break
    return found


@pytest.mark.scaled
@pytest.mark.soak
@pytest.mark.parametrize("place", ["remote"] if SCALE == 1 else ["local", "remote"])
def test_from_grounding_to_answer(place: str, request: pytest.FixtureRequest) -> None:
    service: Service = request.getfixturevalue(place)
    told = answers(service)
    for answer in told:
        assert answer.answer in {"A", "B", "C"}
        assert answer.option in {"Yes", "No", "Not sure"}
        assert answer.not_sure == (answer.answer == "C")
        assert sum(answer.votes.values()) == 2
        assert answer.usage.calls >= 3
        assert answer.usage.input_tokens > 0 < answer.usage.output_tokens
        if answer.simulation is None:
            assert any(code in answer.warnings[0] for code in TYPED), answer.warnings
    imagined = [answer for answer in told if answer.simulation is not None]
    assert imagined, [answer.warnings for answer in told]
    for answer in imagined:
        simulation = answer.simulation
        assert simulation is not None
        assert simulation.grounding.source == simulation.motion.source == "mllm"
        assert simulation.reader.prompts.keys() >= {"identify", "locate"}
        assert len(simulation.frames) == 4
        assert answer.reader.prompts.keys() >= {"identify", "locate", "answer-with-frames"}
    assert {answer.reader.name for answer in told} == {"local" if place == "local" else "mllm"}


def test_the_same_seed_gives_the_same_answer(local: Service) -> None:
    scene = example("ball-and-mug")
    image = local.keep_image(scene.image)
    body = {"image": {"artifact": image.sha256}, "question": scene.meta["question"], "imagine": "never", "seed": 3}
    first, second = (local.answer(AnswerRequest.model_validate(body)) for _ in range(2))
    assert (first.answer, first.reasoning) == (second.answer, second.reasoning)


def test_a_wrong_path_on_the_server_is_a_typed_error(remote: Service) -> None:
    """Asked for under another name, the second process still answers; on another path it does not."""
    address = str(remote.settings.mllm_base_url)
    assert httpx.post(address + "/nothing", json={}).status_code == 404
    settings = Settings(data_dir=remote.settings.data_dir, mllm="tiny-qwen3-vl", mllm_base_url=address + "/wrong")
    image = remote.keep_image(example("ball-and-mug").image)
    request = AnswerRequest.model_validate({"image": {"artifact": image.sha256}, "question": "Will it move?"})
    with Service(settings) as service, pytest.raises(CowError) as told:
        service.answer(request)
    assert told.value.code == "mllm-unavailable"
