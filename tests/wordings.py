"""What the service makes of wordings of questions: right, refused, not sure, or wrong without a word."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from conftest import ROOT

from cow_service.errors import CowError
from cow_service.records import Answer, Asked
from cow_service.requests import AnswerRequest
from cow_service.service import Service

SEEN = ROOT / "tests" / "data" / "wordings" / "seen.json"
_SAME = {
    "cup": "mug",
    "can": "cylinder",
    "box": "cube",
    "sphere": "ball",
    "teal": "cyan",
    "gray": "grey",
    "beside": "next-to",
    "over": "onto",
}
_WORDLESS = {"falling", "the", "a", "one", "it", "thing", "of", "toy", "object"}


@dataclass(frozen=True)
class Verdict:
    """`kind` is right, refused, not-sure or wrong."""

    question: str
    kind: str  # right, refused, not-sure or wrong
    expected: str
    said: str


def items(path: Path = SEEN) -> list[dict[str, Any]]:
    return json.loads(path.read_text())


def verdicts(service: Service, path: Path = SEEN, part: slice = slice(None)) -> Iterator[Verdict]:
    """The result of each item."""
    for item in items(path)[part]:
        yield verdict(service, item)


def verdict(service: Service, item: dict[str, Any]) -> Verdict:
    expect, question = item["expect"], item["question"]
    image = service.keep_image((ROOT / item["picture"]).read_bytes())
    body = {"image": {"artifact": image.sha256}, "question": question, "options": item["options"], "ensemble": 20}
    expected = f"refuse: {expect['refuse']}" if expect["refuse"] else str(expect["answer"] or expect["asked"])
    try:
        answer = service.answer(AnswerRequest.model_validate({**body, "frames": {"count": 1}}))
    except (CowError, ValueError) as error:
        return Verdict(question, "refused", expected, str(error)[:300])
    problem = answer.simulation_problem
    if problem is not None:
        return Verdict(question, "refused", expected, problem.detail[:300])
    if answer.not_sure:
        # Understood, and the worlds disagree where the picture alone does not settle it: what must be said.
        outcome = None if answer.simulation is None else answer.simulation.trajectory.outcome
        decided = outcome is not None and outcome.probability is not None
        open_ = expect["refuse"] is None and expect["answer"] is None and decided and _reads_as(answer, expect)
        return Verdict(question, "right" if open_ else "not-sure", expected, " ".join(answer.warnings)[:300])
    said = f"{answer.option or answer.answer}: {_reading(answer)}"
    if expect["refuse"]:
        warned = any(word in " ".join(answer.warnings).lower() for word in _words(expect["refuse"]))
        return Verdict(question, "right" if warned else "wrong", expected, said)
    known = expect["answer"]
    right = _reads_as(answer, expect) if known is None else _says(answer, str(known))
    return Verdict(question, "right" if right else "wrong", expected, said)


def _words(text: str | None) -> set[str]:
    return {_SAME.get(word, word) for word in re.findall(r"[\w-]+", (text or "").lower())} - _WORDLESS


def _says(answer: Answer, expected: str) -> bool:
    said = _words(answer.option or answer.answer)
    if expected in ("yes", "no"):
        return {"yes": {"yes", "true"}, "no": {"no", "false"}}[expected].isdisjoint(said) is False
    return _words(expected) <= said or (bool(said) and said <= _words(expected))


def _reads_as(answer: Answer, expect: dict[str, Any]) -> bool:
    """Whether an answer that no picture can prove rests on the right reading of the question."""
    simulation = answer.simulation
    outcome = None if simulation is None else simulation.trajectory.outcome
    if simulation is None or outcome is None:
        return False
    mover = _words(simulation.grounding.object) <= _words(expect["mover"])
    changed = [(each.kind, _words(each.object.object)) for each in simulation.grounding.interventions]
    wanted = [(each["kind"], _words(each["object"])) for each in expect["interventions"]]
    same = len(changed) == len(wanted) and all(
        a[0] == b[0] and a[1] <= b[1] for a, b in zip(changed, wanted, strict=True)
    )
    return mover and same and _asks(outcome.asked, expect["asked"], expect["mover"])


def _asks(asked: Asked, wanted: dict[str, Any], mover: str) -> bool:
    """Whether the question was read correctly: "the mug is covered by the ball" is "the ball covers the mug"."""
    relation, subject, target = wanted["relation"], wanted["subject"], wanted["target"]
    if relation in ("covers", "covered") and asked.relation != relation:
        relation, subject, target = asked.relation, target, subject or mover
    if relation in ("tips", "moves") and target is None:
        subject, target = None, subject
    named = all(
        a is None or b is None or _words(a) <= _words(b) or _words(b) <= _words(a)
        for a, b in ((asked.target, target), (asked.subject or mover, subject or mover))
    )
    return (
        (asked.form, asked.negated) == (wanted["form"], wanted["negated"])
        and named
        and (relation is None or asked.relation == relation)
    )


def _reading(answer: Answer) -> str:
    simulation = answer.simulation
    outcome = None if simulation is None else simulation.trajectory.outcome
    if simulation is None or outcome is None:
        return "no outcome"
    return f"{outcome.asked.model_dump(exclude_defaults=True)}; {simulation.narration.story}"
