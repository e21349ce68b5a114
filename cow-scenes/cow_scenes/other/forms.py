"""The second family's questions: worlds on a table top or on a floor, in real sizes and speeds."""

import numpy as np

from ..forms.base import Draft, Form, arrow_words, choose_along, hits_target, off_target, push, unit
from ..forms.billiards import judge as judge_billiards
from ..forms.occlude import judge as judge_occlude
from ..forms.put import judge_fall
from ..world import Run
from .physics import Fixture
from .shapes import Solid, shapes
from .stage import ROUND, Random, Stage, open_stage, rolling

FLAT = ("cube", "box", "book", "chair", "cylinder")
"""What can be landed on."""
VESSELS = ("mug", "pot", "basket", "bowl")
RATIOS = ((0.80, 0.96), (1.04, 1.20))
"""Width of what is put over the vessel's opening, for Yes and for No."""
GRAVITY = 9.81


def pair(stage: Stage, want: int) -> tuple[Solid, Solid, float, float]:
    """A mover and a target, the heading that hits or misses it, and the way between them."""
    start, heading, away = stage.spot(0.8), stage.number(0, 2 * np.pi), stage.reach * stage.number(0.8, 1.5)
    mover = stage.add(stage.choose(stage.nouns if stage.random.uniform() < 0.5 else ROUND), start)
    target = stage.add(stage.choose(stage.nouns), start + away * unit(heading))
    near = float(np.arcsin(min(1.0, (mover.radius + target.radius) / away)))
    heading += off_target(stage.random, near) if want == 1 else stage.number(-0.3, 0.3) * near
    return mover, target, heading, away


def draw_slide(random: Random, level: str, want: int) -> Draft:
    """An object with an arrow, and a target."""
    stage, along = open_stage(random), choose_along(random)
    mover, target, heading, away = pair(stage, want)
    stage.add_others(level)
    question = f"If the {mover.name} moves {arrow_words(along)}, will it hit the {target.name}?"
    return stage.draft(
        "slide", "linear", question, target, **stage.launch(mover, heading, away), arrow=True, along=along
    )


def draw_towards(random: Random, level: str, want: int) -> Draft:
    """An object moves towards another; it hits that one, one before it, or is stopped, or one stands aside."""
    stage = open_stage(random)
    mover, goal, heading, away = pair(stage, 0)
    start = np.array(mover.centre[:2])
    heading = float(np.arctan2(*(np.array(goal.centre[:2]) - start)[::-1]))
    between = stage.random.uniform() < 0.5
    turn = 0.0 if between else off_target(stage.random, 0.4)
    third = stage.add(stage.choose(stage.nouns), start + away * unit(heading + turn) * (0.5 if between else 1.0))
    # In between, the third is hit and stops the mover; aside, it is missed and bars nothing.
    target = third if between == (want == 0) else goal
    stage.add_others(level)
    question = f"If the {mover.name} moves towards the {goal.name}, will it hit the {target.name}?"
    return stage.draft("towards", "linear", question, target, **stage.launch(mover, heading, away))


def judge_towards(draft: Draft, run: Run) -> int | None:
    """As for a slide, but what is stopped on its way never gets there, however near it ends."""
    mover, things = draft.world.mover, {t.name for t in draft.world.things}
    if run.first(mover, draft.target) is not None:
        return hits_target(draft, run)
    stopped = any(mover in {c.a, c.b} and {c.a, c.b} <= things for c in run.contacts)
    return 1 if stopped and run.gaps[draft.target] > 0.02 else hits_target(draft, run)


def draw_remove(random: Random, level: str, want: int) -> Draft:
    """What bars the way is taken away first."""
    stage, along = open_stage(random), choose_along(random)
    mover, target, heading, away = pair(stage, want)
    at = np.array(mover.centre[:2]) + away * stage.number(0.4, 0.55) * unit(heading)
    barrier = stage.add(stage.choose(stage.nouns), at)
    stage.add_others(level)
    words = f"If the {barrier.name} is removed and the {mover.name} moves {arrow_words(along)}"
    return stage.draft(
        "remove", "linear", f"{words}, will it hit the {target.name}?", target, **stage.launch(mover, heading, away),
        arrow=True, along=along, removed=barrier.name,
    )  # fmt: skip


def draw_throw(random: Random, level: str, want: int) -> Draft:
    """Something in the air with an arrow."""
    stage, along = open_stage(random), choose_along(random)
    start, heading, away = stage.spot(0.8), stage.number(0, 2 * np.pi), stage.reach * stage.number(0.7, 1.4)
    mover = stage.add(stage.choose(ROUND), start, stage.reach * stage.number(0.2, 0.6))
    target = stage.add(stage.choose(stage.nouns), start + away * unit(heading))
    time = stage.number(0.2, 0.35) * (1.3 + 0.7 * (stage.reach > 1))
    drop = target.centre[2] + stage.number(-0.2, 0.2) * target.height - mover.centre[2]
    if want == 1:
        heading += off_target(random, float(np.arcsin(min(1, (mover.radius + target.radius) / away))))
    stage.add_others(level)
    question = f"If the {mover.name} is thrown {arrow_words(along)}, will it hit the {target.name}?"
    velocity = push(heading, away / time, drop / time + GRAVITY * time / 2)
    return stage.draft("throw", "projectile", question, target, velocity, arrow=True, along=along)


def draw_billiards(random: Random, level: str, want: int) -> Draft:
    """A rolling ball hits a second one, which may hit a third or something else."""
    stage, along = open_stage(random), choose_along(random)
    second, leave = stage.spot(0.3), stage.number(0, 2 * np.pi)
    scale = stage.number(*stage.sizes("ball"))
    radius = shapes()["ball"].radius * scale
    heading = leave + stage.number(-0.35, 0.35)
    first = second - 2 * radius * unit(leave) - stage.reach * stage.number(0.35, 0.7) * unit(heading)
    miss = random.choice([-1, 1]) * stage.number(0.6, 2.0) if want == 1 else stage.number(-0.08, 0.08)
    mover, via = stage.add("ball", first, scale=scale), stage.add("ball", second, scale=scale)
    target = stage.add(
        stage.choose(("ball", "cube", "can", "box", "cylinder")),
        second + stage.reach * stage.number(0.6, 0.95) * unit(leave + miss),
    )
    stage.add_others(level)
    question = f"If the {mover.name} moves {arrow_words(along)}, will the {via.name} hit the {target.name}?"
    more = stage.launch(mover, heading, stage.reach * 0.9)
    return stage.draft("billiards", "linear", question, target, **more, arrow=True, along=along, via=via.name)


def draw_ramp(random: Random, level: str, want: int) -> Draft:
    """Something round near the top of a ramp."""
    stage = open_stage(random)
    foot, heading, slope = stage.spot(0.3), stage.number(0, 2 * np.pi), np.radians(stage.number(12, 35))
    length = stage.reach * stage.number(0.5, 0.9)
    noun = stage.choose(("ball", "ball", "orange"))
    scale = stage.number(*stage.sizes(noun))
    radius = shapes()[noun].height * scale / 2
    size = (float(length), float(radius * stage.number(3, 5)), float(length * np.tan(slope)))
    middle = foot - unit(heading) * length / 2
    stage.fixtures.append(Fixture("ramp", (float(middle[0]), float(middle[1])), heading, size))
    stage.blocked.append((middle, float(np.hypot(*size[:2])) / 2))
    # It touches the slope `back` metres behind the foot; its centre is a radius away along the slope's normal.
    back = length * stage.number(0.7, 0.92)
    at = foot - unit(heading) * (back - radius * np.sin(slope))
    height = back * np.tan(slope) + radius * np.cos(slope)
    mover = stage.add(noun, at, height - radius, scale)
    turn = off_target(random, 0.35) if want == 1 else stage.number(-0.1, 0.1)
    target = stage.add(stage.choose(stage.nouns), foot + stage.reach * stage.number(0.35, 0.9) * unit(heading + turn))
    stage.add_others(level)
    question = f"If the {mover.name} rolls down the ramp, will it hit the {target.name}?"
    velocity = push(heading, 0.1 * float(np.cos(slope)), -0.1 * float(np.sin(slope)))
    return stage.draft("ramp", "linear", question, target, velocity, spin=rolling(mover, velocity))


def draw_step(random: Random, level: str, want: int) -> Draft:
    """Something moves over a step and off its edge."""
    stage, along = open_stage(random), choose_along(random)
    centre, heading = stage.spot(0.3), stage.number(0, 2 * np.pi)
    length, height = stage.reach * stage.number(0.5, 0.8), stage.reach * stage.number(0.15, 0.4)
    size = (length, stage.reach * stage.number(0.4, 0.8), height)
    stage.fixtures.append(Fixture("step", (float(centre[0]), float(centre[1])), heading, size))
    stage.blocked.append((centre, float(np.hypot(*size[:2])) / 2))
    edge = centre + unit(heading) * length / 2
    noun = stage.choose(ROUND if random.uniform() < 0.5 else ("mug", "book", "can", "box", "cube"))
    mover = stage.add(noun, centre - unit(heading) * length * stage.number(-0.1, 0.3), height)
    turn = off_target(random, 0.4) if want == 1 else stage.number(-0.05, 0.05)
    target = stage.add(stage.choose(stage.nouns), edge + stage.reach * stage.number(0.25, 0.8) * unit(heading + turn))
    stage.add_others(level)
    verb = "rolls" if noun in ROUND else "slides"
    question = f"If the {mover.name} {verb} {arrow_words(along)}, will it hit the {target.name}?"
    return stage.draft(
        "step", "linear", question, target, **stage.launch(mover, heading, stage.reach), arrow=True, along=along
    )


def draw_fall(random: Random, level: str, want: int) -> Draft:
    """Something above an object with a flat top, or beside it."""
    stage = open_stage(random)
    at = stage.spot(0.4)
    target = stage.add(stage.choose(FLAT), at)
    noun = stage.choose(("ball", "cube", "apple", "orange", "can", "pear"))
    scale = stage.number(*stage.sizes(noun))
    apart = target.radius + shapes()[noun].radius * scale + stage.reach * stage.number(0.1, 0.4)
    over = at + (stage.number(0, 0.2) * target.radius if want == 0 else apart) * unit(stage.number(0, 2 * np.pi))
    mover = stage.add(noun, over, target.height + stage.reach * stage.number(0.2, 0.6), scale)
    stage.things.reverse()
    stage.add_others(level)
    question = f"If the {mover.name} falls freely from its current position, will it land on the {target.name}?"
    return stage.draft("fall", "fall", question, target)


def draw_place(random: Random, level: str, want: int) -> Draft:
    """Something turned anyhow beside a vessel, somewhat narrower or wider than its opening."""
    stage = open_stage(random)
    at = stage.spot(0.4)
    noun = stage.choose(("ball", "apple", "orange", "cube", "box", "can", "cylinder"))
    vessel_noun = stage.choose(VESSELS)
    vessel_scale = stage.number(*stage.sizes(vessel_noun))
    scale = stage.number(*RATIOS[want]) * shapes()[vessel_noun].opening * vessel_scale / (2 * shapes()[noun].radius)
    reach = shapes()[noun].radius * scale + shapes()[vessel_noun].radius * vessel_scale
    beside = unit(stage.number(0, 2 * np.pi)) * (reach + stage.reach * stage.number(0.1, 0.4))
    mover = stage.add(noun, at + beside, scale=scale)
    vessel = stage.add(vessel_noun, at, scale=vessel_scale)
    stage.add_others(level)
    above = (*map(float, at), vessel.height + mover.height / 2 + 0.04)
    question = f"If I put the {mover.name} into the {vessel.name}, will it fit inside?"
    return stage.draft("place", "fall", question, vessel, carry_to=above)


def judge_place(draft: Draft, run: Run) -> int | None:
    """Yes if its centre ends in the upright vessel and below the rim, No if it ends on the rim."""
    mover, vessel = draft.world.thing(draft.world.mover), draft.world.thing(draft.target)
    sizes = [s for s in (*shapes()[mover.shape].table, *shapes()[mover.shape].floor) if s]
    if not 0.85 * min(sizes) <= mover.scale <= 1.15 * max(sizes) or mover.height > 1.6 * vessel.height:
        return None
    if any(not {c.a, c.b} <= {mover.name, vessel.name, "floor"} for c in run.contacts):
        return None
    end, rest, turn = run.centres[mover.name][-1], run.centres[vessel.name][-1], run.turns[vessel.name][-1]
    if np.hypot(turn[0], turn[1]) > 0.05 or np.hypot(*(end - rest)[:2]) > vessel.opening / 2:
        return None
    over = end[2] - rest[2] - vessel.height / 2
    return 0 if over < -0.1 * mover.height else 1 if over > 0.02 * mover.height else None


def draw_occlude(random: Random, level: str, want: int) -> Draft:
    """The mover crosses the line of sight in front of the target, or behind it, or leaves."""
    stage, along = open_stage(random), choose_along(random)
    view, at = stage.number(0, 2 * np.pi), stage.spot(0.3)
    side, behind = random.choice([-1, 1]), want == 1 and random.uniform() < 0.5
    heading = view + side * (np.pi / 2 + stage.number(-0.6, 0.6))
    cross = at + stage.reach * stage.number(0.35, 0.8) * (-1 if behind else 1) * unit(view)
    start = cross - stage.reach * stage.number(0.5, 0.9) * unit(heading)
    if want == 1 and not behind:
        heading += np.pi + stage.number(-0.5, 0.5)
    mover, target = stage.add(stage.choose(stage.nouns), start), stage.add(stage.choose(stage.nouns), at)
    stage.add_others(level)
    question = f"If the {mover.name} moves {arrow_words(along)}, will the {target.name} be occluded at some moment?"
    more = stage.launch(mover, float(heading), stage.reach)
    return stage.draft("slide-occlude", "linear", question, target, **more, arrow=True, along=along, view_yaw=view)


FORMS: dict[str, Form] = {
    "slide": Form(draw_slide, hits_target),
    "towards": Form(draw_towards, judge_towards),
    "remove": Form(draw_remove, hits_target),
    "throw": Form(draw_throw, hits_target),
    "billiards": Form(draw_billiards, judge_billiards),
    "ramp": Form(draw_ramp, hits_target),
    "step": Form(draw_step, hits_target),
    "fall": Form(draw_fall, judge_fall),
    "place": Form(draw_place, judge_place),
    "slide-occlude": Form(draw_occlude, judge_occlude),
}
