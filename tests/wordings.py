"""What the service makes of wordings of questions: right, refused, not sure, or wrong without a word."""

from __future__ import annotations

import json
import re
from typing import Any

from conftest import DATA, ROOT

from cow_service.errors import CowError
from cow_service.records import Answer, Asked
from cow_service.requests import AnswerRequest
from cow_service.service import Service

_SAME = {
    "cup": "mug", "can": "cylinder", "box": "cube", "sphere": "ball", "teal": "cyan", "gray": "grey",
    "beside": "next-to", "over": "onto",
}  # fmt: skip
_WORDLESS = {"falling", "the", "a", "one", "it", "thing", "of", "toy", "object"}


def items() -> dict[str, dict[str, Any]]:
    """The wordings by their question; data/wordings/README.md says what they hold."""
    return {item["question"]: item for item in json.loads((DATA / "wordings" / "seen.json").read_text())}


def verdict(service: Service, item: dict[str, Any]) -> str:
    """Whether the answer is `right`, `refused`, `not-sure` or `wrong`."""
    expect = item["expect"]
    image = service.keep_image((ROOT / item["picture"]).read_bytes())
    body = {"image": {"artifact": image.sha256}, "ensemble": 20, "frames": {"count": 1}}
    body |= {name: item[name] for name in ("question", "options")}
    try:
        answer = service.answer(AnswerRequest.model_validate(body))
    except (CowError, ValueError):
        return "refused"
    if answer.simulation_problem is not None:
        return "refused"
    if answer.not_sure:
        # Understood, and the worlds disagree where the picture alone does not settle it: what must be said.
        outcome = None if answer.simulation is None else answer.simulation.trajectory.outcome
        is_open = expect["refuse"] is None and expect["answer"] is None and outcome is not None
        is_right = is_open and outcome.probability is not None and reads_as(answer, expect)
        return "right" if is_right else "not-sure"
    if expect["refuse"]:
        is_right = any(word in " ".join(answer.warnings).lower() for word in words(expect["refuse"]))
    else:
        known = expect["answer"]
        is_right = reads_as(answer, expect) if known is None else says(answer, str(known))
    return "right" if is_right else "wrong"


def words(text: str | None) -> set[str]:
    """The words of a text that tell something, alike where they mean the same."""
    return {_SAME.get(word, word) for word in re.findall(r"[\w-]+", (text or "").lower())} - _WORDLESS


def says(answer: Answer, expected: str) -> bool:
    """Whether an answer is the one that is known."""
    said = words(answer.option or answer.answer)
    if expected in ("yes", "no"):
        return not {"yes": {"yes", "true"}, "no": {"no", "false"}}[expected].isdisjoint(said)
    return words(expected) <= said or (bool(said) and said <= words(expected))


def reads_as(answer: Answer, expect: dict[str, Any]) -> bool:
    """Whether an answer that no picture can prove rests on the right reading of the question."""
    simulation = answer.simulation
    outcome = None if simulation is None else simulation.trajectory.outcome
    if simulation is None or outcome is None:
        return False
    grounding = simulation.grounding
    changes = [(each.kind, each.object.object) for each in grounding.interventions]
    return is_reading(grounding.object, changes, outcome.asked, expect)


def is_reading(mover: str, changes: list[tuple[str, str]], asked: Asked, expect: dict[str, Any]) -> bool:
    """Whether mover, changes and what is asked are those expected: "the mug is covered by the ball" is "the ball covers
    the mug"."""
    wanted = expect["asked"]
    relation, subject, target = wanted["relation"], wanted["subject"], wanted["target"]
    if relation in ("covers", "covered") and asked.relation != relation:
        relation, subject, target = asked.relation, target, subject or expect["mover"]
    if relation in ("tips", "moves") and target is None:
        subject, target = None, subject
    same = [(words(mover), words(expect["mover"]))]
    same += [
        (words(said), words(change["object"]))
        for (_, said), change in zip(changes, expect["interventions"], strict=False)
    ]
    alike = ((asked.target, target), (asked.subject or expect["mover"], subject or expect["mover"]))
    return (
        [kind for kind, _ in changes] == [change["kind"] for change in expect["interventions"]]
        and all(said <= meant for said, meant in same)
        and all(None in (a, b) or words(a) <= words(b) or words(b) <= words(a) for a, b in alike)
        and (asked.form, asked.negated) == (wanted["form"], wanted["negated"])
        and relation in (None, asked.relation)
    )
