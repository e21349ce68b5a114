"""Inspect, a public evaluation harness, measures through a real server: its scores are those of the letters drawn."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from conftest import SCALE
from random_mllm import USAGE, RandomMllm, random_mllm
from servers import QUESTION, Served, picture

pytestmark = [pytest.mark.soak, pytest.mark.slow, pytest.mark.timeout(300)]
SAMPLES, EPOCHS, SEED = 4, 2 * SCALE, 3
IMAGINING = ("openai-api/local/cow/qwen3-vl-8b", "openai/cow/qwen3-vl-8b")
CONTROL = "openai-api/local/cow/qwen3-vl-8b:still:initial"
WITHOUT = "openai-api/local/cow/qwen3-vl-8b:no-imagination"
EMBEDDED = "openai-api/local/cow/embedded"
ASKED = SAMPLES * EPOCHS
# Inspect's stock multiple choice, run as its documentation tells; the models are its arguments, JSON its output.
PROGRAM = """
import json, os, sys
from inspect_ai import Task, eval
from inspect_ai.dataset import Sample
from inspect_ai.model import ChatMessageUser, ContentImage, ContentText, get_model
from inspect_ai.scorer import choice
from inspect_ai.solver import multiple_choice

question, epochs, images, models = json.loads(sys.argv[1])
samples = [
    Sample(
        input=[ChatMessageUser(content=[ContentImage(image=image), ContentText(text=question)])],
        choices=["Yes", "No"],
        target="AB"[number % 2],
    )
    for number, image in enumerate(images)
]
task = Task(dataset=samples, solver=multiple_choice(), scorer=choice(), epochs=epochs)
told = []
for name, options in models:
    (log,) = eval(task, model=get_model(name, **options), display="none", log_dir="logs", max_retries=0)
    told.append(
        {
            "model": name,
            "status": log.status,
            "error": log.error and log.error.message,
            "accuracy": log.results and log.results.scores[0].metrics["accuracy"].value,
            "replies": [[sample.output.completion, sample.target] for sample in log.samples or ()],
            "tokens": [usage.total_tokens for usage in log.stats.model_usage.values()],
        }
    )
print(json.dumps(told))
"""


@pytest.fixture(scope="module")
def mllm() -> Iterator[RandomMllm]:
    with random_mllm() as one:
        yield one


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory: pytest.TempPathFactory, mllm: RandomMllm) -> dict[str, dict[str, Any]]:
    """What Inspect says of each model, by the model's name."""
    folder = tmp_path_factory.mktemp("inspect")
    images = [str(folder / f"{number}.png") for number in range(SAMPLES)]
    for number, path in enumerate(images):
        Path(path).write_bytes(picture(number))
    stored_nowhere = {"responses_api": True, "responses_store": False}
    models = [
        (name, stored_nowhere if name.startswith("openai/") else {})
        for name in (*IMAGINING, CONTROL, WITHOUT, EMBEDDED)
    ]
    mllm.draws.seed(SEED)
    own = {"COW_MLLM": "qwen3-vl-8b", "COW_MLLM_BASE_URL": mllm.address, "COW_READER": "embedded"}
    with Served(folder, **own) as served:
        address = f"{served.http.base_url}/v1"
        environment = {name: value for name, value in os.environ.items() if not name.startswith(("COW_", "INSPECT_"))}
        for name in ("LOCAL", "OPENAI"):
            environment |= {f"{name}_BASE_URL": address, f"{name}_API_KEY": "none"}
        command = [sys.executable, "-c", PROGRAM, json.dumps([QUESTION, EPOCHS, images, models])]
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
        assert "Traceback" not in served.log()
    told = json.loads(done.stdout.splitlines()[-1])
    assert [each["error"] for each in told] == [None] * len(models)
    return {each["model"]: each for each in told}


def letters(told: dict[str, Any]) -> list[str]:
    return [reply.rpartition("ANSWER: ")[2] for reply, _ in told["replies"]]


def test_the_score_is_that_of_the_letters_drawn(evaluated: dict[str, Any], mllm: RandomMllm) -> None:
    for name in (*IMAGINING, CONTROL, WITHOUT):
        told = evaluated[name]
        assert (told["status"], len(told["replies"])) == ("success", ASKED)
        right = [letter == target for letter, (_, target) in zip(letters(told), told["replies"], strict=True)]
        assert told["accuracy"] == pytest.approx(sum(right) / ASKED)
        assert 0 < sum(right) < ASKED, "repeats differ by what the MLLM draws"
        assert told["tokens"] == [ASKED * USAGE["total_tokens"]]
    received = [json.dumps(each.fields["messages"]).count('"image_url":') for each in mllm.received]
    shown = Counter(count for count in received if count)  # the provider of OpenAI's own models says hello first
    assert shown == {1: ASKED, 4: ASKED, 5: 2 * ASKED}, "one call each, with frames or without"
    assert set(letters(evaluated[EMBEDDED])) == {"A"}
    assert evaluated[EMBEDDED]["accuracy"] == pytest.approx(0.5)
