"""Rejection sampling: draws worlds until one is clear, in view and has the wanted answer. Nothing is rendered."""

from dataclasses import dataclass, replace

import numpy as np

from .camera import Camera, draw_camera
from .errors import NoWorldError
from .forms import FORM_OF, Draft, Form
from .physics import simulate
from .plan import ItemKey
from .raster import depth_of, depths, hidden_share, id_picture, placed
from .world import SAMPLES, Run, Thing

TRIES, VIEWS = 2000, 10
EDGE, LEAST = 8, 30
"""Pixels of a picture 832 wide: distance to the border, smallest side of a box."""
COVERED, CLEAR = 0.40, 0.20
"""Shares of the target's silhouette: occluded from the first on, not occluded up to the second."""
CHECK_WIDTH = 208


@dataclass(frozen=True)
class Accepted:
    """A world that is made into an item: `answer` is the option's index, `hidden` the largest hidden share.

    `factual` is what happens if nothing is taken away, for the form `remove`.
    """

    key: ItemKey
    draft: Draft
    run: Run
    camera: Camera
    answer: int
    factual: Run | None = None
    hidden: float | None = None


def overlapping(things: tuple[Thing, ...]) -> bool:
    """Whether two objects on about the same height are in each other's way at t = 0."""
    return any(
        np.hypot(*np.subtract(a.centre[:2], b.centre[:2])) < a.radius + b.radius + 0.05
        and abs(a.centre[2] - b.centre[2]) < (a.height + b.height) / 2 + 0.05
        for i, a in enumerate(things)
        for b in things[:i]
    )


def trail_of(draft: Draft) -> np.ndarray:
    """Earlier centres (n, 3) in metres on the mover's parabola, the last first."""
    start, v = np.array(draft.world.thing(draft.world.mover).centre), np.array(draft.world.velocity)
    return np.array([start - v * t - np.array([0, 0, 9.81 * t * t / 2]) for t in draft.trail_times]).reshape(-1, 3)


def trail_clear(draft: Draft) -> bool:
    """Earlier positions are above the floor, apart from everything, and farther from the target than the last."""
    if not draft.trail_times:
        return True
    trail, ball = trail_of(draft), draft.world.thing(draft.world.mover)
    target = np.array(draft.world.thing(draft.target).centre)
    others = [t for t in draft.world.things if t.name != ball.name]
    apart = all(np.linalg.norm(p - np.array(t.centre)) > t.radius + t.height / 2 + 0.1 for p in trail for t in others)
    now = np.linalg.norm(np.array(ball.centre) - target)
    return bool(apart and trail[:, 2].min() > 0.2 and (np.linalg.norm(trail - target, axis=1) > now + 0.04).all())


def still(thing: Thing) -> tuple[np.ndarray, np.ndarray]:
    """Pose of an object as drawn, before it moves: centre (3,) and quaternion (4,)."""
    return np.array(thing.centre), np.array([0, 0, np.sin(thing.yaw / 2), np.cos(thing.yaw / 2)])


def in_view(draft: Draft, camera: Camera) -> bool:
    """Everything is inside the picture, large enough, and hardly hidden; an arrow has room to show a direction."""
    unit = camera.width / 832
    for thing in draft.world.things:
        vertices = placed(thing, *still(thing))
        if camera.to_camera(vertices)[:, 2].min() < 0.3:
            return False
        pixels = camera.project(vertices)
        low, high = pixels.min(0), pixels.max(0)
        if (low < EDGE * unit).any() or (high > np.array([camera.width, camera.height]) - EDGE * unit).any():
            return False
        if (high - low).min() < LEAST * unit:
            return False
    for point in trail_of(draft):
        reach = 0.16 * camera.focal / camera.to_camera(point)[2]
        x, y = camera.project(point)
        if not (reach < x < camera.width - reach and reach < y < camera.height - reach):
            return False
    start, v = np.array(draft.world.thing(draft.world.mover).centre), np.array(draft.world.velocity)
    moved = float(np.linalg.norm(camera.project(start + v * 0.1) - camera.project(start)))
    return not (draft.arrow or draft.trail_times) or moved > 0.45 * 0.1 * float(
        np.linalg.norm(v)
    ) * camera.focal / float(camera.to_camera(start)[2])


def well_seen(draft: Draft, camera: Camera) -> bool:
    """At t = 0 mover and target show 90% of their silhouettes, all others 65%."""
    small = camera.at_width(CHECK_WIDTH, round(CHECK_WIDTH * camera.height / camera.width))
    things = draft.world.things
    layers = depths(small, things, {t.name: still(t) for t in things}, draft.world.table)
    ids = id_picture(layers, {t.name: i + 1 for i, t in enumerate(things)})
    for i, thing in enumerate(things):
        own = np.isfinite(layers[thing.name]).sum()
        least = 0.9 if thing.name in {draft.world.mover, draft.target} else 0.65
        if own == 0 or (ids == i + 1).sum() / own < least:
            return False
    return True


def largest_hidden(draft: Draft, run: Run, camera: Camera) -> float:
    """Largest share of the target's silhouette that the mover hides at any of the 61 samples."""
    small = camera.at_width(CHECK_WIDTH * 2, round(CHECK_WIDTH * 2 * camera.height / camera.width))
    mover, target = draft.world.thing(draft.world.mover), draft.world.thing(draft.target)

    def depth(thing: Thing, sample: int) -> np.ndarray:
        vertices = placed(thing, run.centres[thing.name][sample], run.turns[thing.name][sample])
        return depth_of(small, vertices, thing.surface[1])

    own = depth(target, 0)
    columns = np.flatnonzero(np.isfinite(own).any(0))
    worst = 0.0
    for sample in range(SAMPLES):
        centre = run.centres[mover.name][sample]
        reach = small.focal * (mover.radius + mover.height) / max(0.3, float(small.to_camera(centre)[2]))
        x = float(small.project(centre)[0])
        if columns[0] - reach < x < columns[-1] + reach:
            worst = max(worst, hidden_share(own, depth(mover, sample)))
    return worst


def answer_of(draft: Draft, run: Run, camera: Camera, form: Form) -> tuple[int | None, float | None]:
    """The option's index, None if unclear; and the hidden share if the question is about that."""
    answer = form.judge(draft, run)
    if answer != -1:
        return answer, None
    share = largest_hidden(draft, run, camera)
    return (0 if share >= COVERED else 1 if share <= CLEAR else None), share


def holds(draft: Draft, answer: int) -> bool:
    """Whether slightly other pushes lead to the same answer."""
    for degrees, factor in FORM_OF[draft.form].pushes:
        other = replace(draft, world=draft.world.turned(degrees, factor))
        if FORM_OF[draft.form].judge(other, simulate(other.world)) != answer:
            return False
    return True


def view_of(draft: Draft, random: np.random.Generator, width: int, height: int) -> Camera | None:
    """A camera that sees everything well, or None after a few tries."""
    middle = np.mean([t.centre[:2] for t in draft.world.things], 0)
    for _ in range(VIEWS):
        around = np.array([*(middle + random.uniform(-0.15, 0.15, 2)), random.uniform(0.1, 0.35)])
        camera = draw_camera(random, width, height, around, draft.view_yaw)
        if in_view(draft, camera) and fall_clear(draft, camera) and well_seen(draft, camera):
            return camera
    return None


def fall_clear(draft: Draft, camera: Camera) -> bool:
    """A falling object is above the target or, in the picture too, beside it: depth alone never decides."""
    if draft.form != "fall":
        return True
    faller, target = draft.world.thing(draft.world.mover), draft.world.thing(draft.target)
    if np.hypot(*np.subtract(faller.centre[:2], target.centre[:2])) < target.radius:
        return True
    a, b = (camera.project(placed(t, *still(t)))[:, 0] for t in (faller, target))
    return bool(a.max() < b.min() or b.max() < a.min())


def before_camera(draft: Draft, run: Run, camera: Camera) -> bool:
    """Whether every object stays half a metre or more in front of the camera, so that all boxes are real."""
    names = [t.name for t in draft.world.things if t.name != draft.world.removed]
    return all(camera.to_camera(run.centres[n])[:, 2].min() > 0.5 for n in names)


def factual_run(draft: Draft) -> Run | None:
    """What happens with nothing taken away; None for the other forms."""
    return simulate(replace(draft.world, removed=None)) if draft.world.removed else None


def find_world(key: ItemKey, width: int, height: int) -> Accepted:
    """The item's world: the first drawn one that passes every check.

    Raises:
        NoWorldError: if none does within the tries.
    """
    random = key.random("world")
    for _ in range(TRIES):
        draft = FORM_OF[key.form].draw(random, key.level, key.want)
        if overlapping(draft.world.things) or not trail_clear(draft):
            continue
        camera = view_of(draft, random, width, height)
        if camera is None:
            continue
        run = simulate(draft.world)
        if not before_camera(draft, run, camera):
            continue
        answer, hidden = answer_of(draft, run, camera, FORM_OF[key.form])
        if answer != key.want or not holds(draft, key.want):
            continue
        factual = factual_run(draft)
        if factual and factual.first(draft.world.mover, draft.world.removed or "") is None:
            continue
        return Accepted(key, draft, run, camera, key.want, factual, hidden)
    raise NoWorldError(f"{key.id}: no clear world in {TRIES} tries; take another seed than {key.seed}")
