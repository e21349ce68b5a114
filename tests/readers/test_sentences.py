"""No sentence about a world contradicts what happens in it, or the answer that is given from it."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from drawn import Image, ball, block, floor
from runs import run_of
from tables import rows

from cow_service.narration.summary import narrate
from cow_service.narration.words import phrases_of
from cow_service.readers.embedded.answers import choose_option
from cow_service.readers.embedded.reader import EmbeddedReader
from cow_service.records import Grounding, Motion, Trajectory
from cow_service.stages.grounding import ground
from cow_service.stages.motion import settle_motion
from cow_service.stages.trajectory import compute_trajectory

ASKED = (
    "If the red ball rolls to the right, will it hit the blue block?",
    "If the red ball rolls towards the blue block, will it hit it?",
    "If the red ball is thrown to the left, will it land on the floor?",
    "If the red ball falls, will it touch the blue block?",
    "If the red ball moves away from the camera, what will it hit first?",
)
STILL = 0.05  # m/s
TOLD = re.compile(r"(hits and pushes|hits|misses) the (\w+ \w+)")


def drawing(seed: int) -> Image:
    """A red ball left and a blue block right of it, at places and in sizes drawn at random."""
    rng = np.random.default_rng(seed)
    radius, (x, y) = rng.uniform(18, 45), rng.uniform((80, 120), (250, 320))
    side, left, top = (round(value) for value in rng.uniform((50, 360, 90), (110, 500, 260)))
    return block(ball(floor(), (x, y), radius, (200, 30, 30)), (left, top, left + side, top + side), (40, 60, 200))


def contradictions(grounding: Grounding, motion: Motion, told: Trajectory) -> list[str]:
    """What the sentences claim and the records deny."""
    outcome, found = told.outcome, list[str]()
    assert outcome is not None
    narration = narrate(grounding, told, "en")
    clause = narration.story.split(". ")[0].rstrip(".")
    met = {each.object: each for each in told.encounters if each.subject == 0 and each.kind == "touches"}
    for claim, name in TOLD.findall(clause):
        found += [f"{claim} {name}"] if (name in met) == (claim == "misses") else []
        moved = {each.body for each in told.paths}
        found += [f"{claim} {name}"] if claim == "hits and pushes" and met[name].body not in moved else []
    found += ["hits nothing"] if "hits nothing" in clause and met else []
    touches = any(each.b is not None and 0 in (each.a, each.b) for each in told.contacts)
    found += ["hits nothing"] if touches and re.search("hits nothing(?! but| else)", clause) else []
    states, (x, y) = told.path.states, told.path.points[-1]
    rest = re.search(r"comes to rest( on the floor)? after about ([0-9.]+) s$", clause)
    if rest is not None and float(rest[2]) < (len(states) - 1) / told.fps:
        found += ["comes to rest"] if math.hypot(*states[-1][3:]) > STILL else []
    if "leaves the image" in clause and "(after the clip ends)" not in clause:
        x0, y0, x1, y1 = told.bodies[0].bbox
        inside = (x1 - x0) / 2 < x < 640 - (x1 - x0) / 2 and (y1 - y0) / 2 < y < 400 - (y1 - y0) / 2
        found += ["leaves the image"] if inside else []
    if "constant speed" in motion.sentence and motion.law == "contact":
        found.append("constant speed")
    asked, answer = outcome.asked, choose_option((), outcome, narration, phrases_of("en")).answer
    if outcome.sure and asked.form == "whether" and asked.relation == "touches":
        touched = bool(met) if outcome.object is None else outcome.object in met
        found += ["answer"] if (answer == "Yes") != touched else []
    if outcome.sure and asked.form == "which-first":
        first = min(met.values(), key=lambda each: each.first_frame, default=None)
        found += ["first"] if (answer if answer != "Nothing" else None) != (first and first.object) else []
    agree = re.search(r"(\d+) of (\d+) simulated versions agree", narration.agreement)
    if outcome.sure and agree is not None:
        found += ["agree"] if int(agree[1]) < 0.7 * int(agree[2]) else []
    if outcome.time is not None:  # the same time for the same event
        times = {f"{met[outcome.object].time or 0.0:.1f}"} if outcome.object in met and outcome.sure else set[str]()
        found += [] if times <= {f"{outcome.time:.1f}"} else ["time"]
    return [f"{each}: {narration.summary} {narration.story}" for each in found]


@pytest.mark.parametrize(("seed", "question"), rows(
    {"rolls": (0, ASKED[0]), "is thrown": (0, ASKED[2]), "which first": (0, ASKED[4])},
    [(seed, question) for seed in range(1, 9) for question in ASKED],
))  # fmt: skip
def test_no_sentence_contradicts_what_happens(seed: int, question: str) -> None:
    run = run_of(drawing(seed), reader=EmbeddedReader, question=question)
    grounded = ground(run)
    motion = settle_motion(run, grounded.value, grounded.motion)
    told = compute_trajectory(run, grounded.value, motion.value).value
    assert contradictions(grounded.value, motion.value, told) == []
