"""Runs of the evaluation as if they had been asked: drawn pictures, and replies that are made up by a seed."""

from __future__ import annotations

import hashlib
import random
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from drawn import ball, floor, png_bytes

from cow_service.evals.design import arm_of
from cow_service.evals.items import Item, Observation, Task
from cow_service.records import AnswerOption

if TYPE_CHECKING:  # they take seconds to import
    from cow_service.evals.plan import RunInfo
    from cow_service.evals.runs import EvalRun

LETTERS = "ABCD"
LEVELS = {"collision": ("L1", "L2"), "trajectory": ("L1", "L2", "real"), "compatibility": ("?",), "occlusion": ("L1",)}
HOSTILE = 'A</script><img src=x onerror="document.title=1"><b>bold</b> & \u2028 \u202eesrever\u202c 🎱'
RIGHT = {
    "never": 0.45,
    "always": 0.7,
    "auto": 0.66,
    "always:vote-3": 0.52,
    "placebo-still": 0.44,
    "placebo-direction": 0.3,
}


def picture(folder: Path, number: int, name: str = "") -> str:
    """Draws a ball on a floor into `pictures`; returns its digest."""
    centre = (19 + 58 * (number % 7) / 7, 38)
    content = png_bytes(ball(floor(96, 64, seed=number), centre, 13, (200, 30 + 20 * (number % 10), 40)))
    digest = hashlib.sha256(content + name.encode()).hexdigest()
    (folder / "pictures").mkdir(parents=True, exist_ok=True)
    (folder / "pictures" / f"{digest}.png").write_bytes(content)
    return digest


def item(number: int, image: str, task: Task, level: str) -> Item:
    """A question with four options; the last one is unsure."""
    texts = ("It hits the <blue> cube.", "It passes the cube.", "It stops before it.", "I am not sure.")
    start = f"If the red ball number {number} moves to the right, what happens?\nA. "
    return Item(
        id=f"{task}-{number}",
        row=f"questions.jsonl:{number + 1}",
        source_id=str(number),
        image=image,
        question=(start, "\nB. ", "\nC. ", "\nD. ", "\nReply with one letter."),
        options=tuple(AnswerOption(letter=a, text=b) for a, b in zip(LETTERS, texts, strict=True)),
        answer=LETTERS[number % 3],
        abstain="D",
        task=task,
        level=level,
        scene=f"scene-{number // 3}",
    )


def observation(of: Item, arm: str, repeat: int, frames: Sequence[str] = ()) -> Observation:
    """Made up, the same for the same item, arm and repeat."""
    draw = random.Random(f"{of.id} {arm} {repeat}")
    happens = of.answer == "A"
    imagines = arm not in ("never", "placebo-still")
    told = min(1.0, max(0.0, random.Random(of.id).gauss(0.72 if happens else 0.28, 0.22)))
    read: str | None = of.answer if draw.random() < RIGHT.get(arm, 0.5) else draw.choice(LETTERS)
    reply: str | None = f"The ball rolls on until it meets something. The answer is {read}."
    fate = draw.random()
    if fate < 0.03:
        read, reply = None, HOSTILE
    failure = "The model's server did not answer within 120 s." if fate > 0.985 else None
    refused = imagines and 0.9 < fate < 0.95
    return Observation(
        item=of.id,
        task=of.task,
        level=of.level,
        scene=of.scene,
        arm=arm,
        repeat=repeat,
        options=tuple(draw.sample(LETTERS, 4)) if repeat > 1 else tuple(LETTERS),
        truth=of.answer,
        abstain=of.abstain,
        reply=None if failure else reply,
        read=None if failure else read,
        read_as_paper=None if failure else ("A" if read is None else read),
        calls=1 + imagines,
        input_tokens=900 + 1400 * imagines,
        output_tokens=30 + 5 * imagines,
        seconds=1.6 + 22 * imagines * draw.random(),
        imaginations=int(imagines and not refused),
        refusal="object_not_found" if refused else None,
        frames=() if refused or not imagines else tuple(frames),
        probability=told if imagines and not refused else None,
        happens=happens if of.task in ("collision", "occlusion") else None,
        failure=failure,
    )


def info(arms: Sequence[str], repeats: int, items: Sequence[Item], mllm: str = "openai/small") -> RunInfo:
    """What such a run says of itself."""
    from cow_service.evals.plan import RunInfo

    keys = [f"{each.task} {each.level}" for each in items]
    return RunInfo(
        data="questions.jsonl",
        data_digest=hashlib.sha256("".join(each.id for each in items).encode()).hexdigest(),
        counts={key: keys.count(key) for key in sorted(set(keys))},
        faults=("questions.jsonl:9: the picture 'lost.png' <is> not there.",),
        notes=("2 rows share the id 7: told apart by their place.",),
        mllm=mllm,
        ask="prompt",
        arms={arm_of(arm).name: arm_of(arm).model_dump() for arm in arms},
        repeats=repeats,
        seed=7,
        options={"data": "questions.jsonl", "generator": "cutout"},
        versions={"cow-service": "0.1"},
        created_at="2025-01-02T03:04:05Z",
    )


def run(
    folder: Path,
    count: int = 6,
    arms: Sequence[str] = ("never", "always", "placebo-still"),
    repeats: int = 2,
    tasks: Sequence[Task] = ("collision", "trajectory"),
    mllm: str = "openai/small",
) -> EvalRun:
    """Asked about `count` items of these tasks in turn."""
    from cow_service.evals.runs import EvalRun

    items: list[Item] = []
    observations: list[Observation] = []
    frames = [picture(folder, 1000 + each) for each in range(4)]
    for number in range(count):
        task = tasks[number % len(tasks)]
        levels = LEVELS.get(task, ("?",))
        level = levels[number // len(tasks) % len(levels)]
        items.append(item(number, picture(folder, number), task, level))
        observations += [
            observation(items[-1], arm, repeat, frames) for arm in arms for repeat in range(1, repeats + 1)
        ]
    asked = info(arms, repeats, items, mllm)
    return EvalRun(folder, asked, {each.id: each for each in items}, tuple(observations))
