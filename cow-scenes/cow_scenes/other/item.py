"""Makes one item of the second family: finds its world and its camera, draws it with MuJoCo, writes its files."""

from dataclasses import asdict, replace
from pathlib import Path

import mujoco
import numpy as np

from ..accept import Accepted, answer_of, before_camera, fall_clear, in_view, overlapping, still, well_seen
from ..camera import Camera, look_at
from ..errors import NoWorldError
from ..forms import Draft
from ..item import question_picture, write_files
from ..meta import FUTURE, box_of, direction_of
from ..plan import ItemKey
from ..raster import placed
from ..settings import Settings
from ..world import FPS, SAMPLES, Run
from .canvas import Canvas
from .forms import FORMS
from .looks import pick
from .physics import RATE, VARIATIONS, OtherWorld, simulate

TRIES, VIEWS = 3000, 6
SIZES = ((832, 480), (640, 480), (768, 576), (960, 540), (720, 720), (480, 640), (540, 720))
"""Pixels at `--width` 832."""
LENSES, FULL_FRAME = (24, 85), 43.27
"""Millimetres: focal lengths for a full-frame sensor, and its diagonal."""
LEAST_SIDE = 0.034
"""Smallest side of an object's box over the longer side of the picture."""
FINE = {"billiards": 0.3}
"""How much smaller the turns of the variations are."""


def other_world(draft: Draft) -> OtherWorld:
    """A draft's world."""
    assert isinstance(draft.world, OtherWorld)
    return draft.world


def decision(draft: Draft, run: Run) -> int:
    """The sample at which the answer is settled: the touch, or the closest approach."""
    one = draft.via or draft.world.mover
    contact = run.first(one, draft.target)
    if draft.form == "place":
        return SAMPLES - 1
    if contact:
        return contact.sample
    if draft.form == "fall":
        return round(0.5 * FPS)
    return int(np.linalg.norm(run.centres[one] - run.centres[draft.target], axis=1).argmin())


def must_show(draft: Draft, run: Run) -> np.ndarray:
    """Points (n, 3) that have to be inside the picture: everything at t = 0, and the motion until it is settled."""
    world, end = other_world(draft), decision(draft, run) + 1
    mover = world.thing(world.mover)
    path = run.centres[draft.via or mover.name][:end]
    reach = mover.height / 2
    around = [path + off for off in np.concatenate([np.eye(3), -np.eye(3)]) * reach]
    return np.concatenate([
        *(placed(t, *still(t)) for t in world.things), *(f.corners for f in world.fixtures), *around,
        run.centres[mover.name][: end if draft.via is None else 1],
    ])  # fmt: skip


def arrow_fits(item: Accepted) -> bool:
    """Whether the longest arrow would stay inside the picture."""
    draft, camera = item.draft, item.camera
    mover = draft.world.thing(draft.world.mover)
    box = box_of(camera, mover, *still(mover))
    way = direction_of(item) * (1 if draft.along else -1)
    tip = camera.project(np.array(mover.centre)) + way * (0.4 * min(box[2:] - box[:2]) + 120 * camera.width / 832)
    return not draft.arrow or bool((tip > 4).all() and (tip < np.array([camera.width, camera.height]) - 4).all())


def is_small(draft: Draft, camera: Camera) -> bool:
    """Whether an object is too small for its picture, which may be a portrait."""
    boxes = [box_of(camera, t, *still(t)) for t in draft.world.things]
    return min(min(box[2:] - box[:2]) for box in boxes) < LEAST_SIDE * max(camera.width, camera.height)


def sees_all(camera: Camera, points: np.ndarray) -> bool:
    """Whether points (n, 3) are in front of the camera and inside the picture, somewhat away from its border."""
    pixels, edge = camera.project(points), 0.02 * camera.width
    inside = (pixels > edge) & (pixels < np.array([camera.width, camera.height]) - edge)
    return bool(camera.to_camera(points)[:, 2].min() > 0.3 and inside.all())


def draw_view(random: np.random.Generator, points: np.ndarray, scale: float, yaw: float | None) -> Camera:
    """A camera that sees points (n, 3) from as near as it can, or from somewhat farther away."""
    width, height = (round(side * scale) for side in pick(random, SIZES))
    focal = float(np.exp(random.uniform(*np.log(LENSES))) / FULL_FRAME * np.hypot(width, height))
    pitch, roll = np.radians(random.uniform(0, 60)), np.radians(random.uniform(-5, 5) * (random.uniform() < 0.15))
    side = random.uniform(0, 2 * np.pi) if yaw is None else yaw
    back = np.array([np.cos(side) * np.cos(pitch), np.sin(side) * np.cos(pitch), np.sin(pitch)])
    middle, c, s = (points.min(0) + points.max(0)) / 2, np.cos(roll), np.sin(roll)

    def camera_at(away: float) -> Camera:
        pose = look_at(middle + back * away, middle)
        pose[:3, :3] = pose[:3, :3] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        return Camera(focal, width, height, pose)

    near, away = 0.0, 60.0
    for _ in range(20):
        half = (near + away) / 2
        near, away = (near, half) if sees_all(camera_at(half), points) else (half, away)
    return camera_at(away * random.uniform(1.0, 1.2))


def view_of(draft: Draft, run: Run, random: np.random.Generator, scale: float) -> Camera | None:
    """A camera that sees everything well, or None after a few tries."""
    points = must_show(draft, run)
    for _ in range(VIEWS):
        camera = draw_view(random, points, scale, draft.view_yaw)
        if camera.pose[2, 3] < 0.03 or not sees_all(camera, points) or not in_view(draft, camera):
            continue
        if is_small(draft, camera) or not fall_clear(draft, camera):
            continue
        if well_seen(draft, camera) and before_camera(draft, run, camera):
            return camera
    return None


def holds(item: Accepted) -> bool:
    """Whether the answer is the same under all variations."""
    draft, world = item.draft, other_world(item.draft)
    form = FORMS[draft.form]
    for variation in VARIATIONS:
        varied = world.varied(variation, FINE.get(draft.form, 1.0))
        other, run = replace(draft, world=varied), simulate(varied)
        if item.hidden is not None and np.allclose(run.centres[world.mover], item.run.centres[world.mover], atol=1e-3):
            # What is hidden is slow to compute, and the same for the same motion.
            continue
        if answer_of(other, run, item.camera, form)[0] != item.answer:
            return False
    return True


def is_still(world: OtherWorld, run: Run) -> bool:
    """Whether nothing but the mover moves by itself at the start."""
    others = [run.centres[t.name] for t in world.things if t.name not in {world.mover, world.removed}]
    return all(np.abs(centres[2] - centres[0]).max() < 0.003 for centres in others)


def find_other(key: ItemKey, scale: float) -> tuple[Accepted, Canvas]:
    """The item's world and how it looks: the first drawn one that passes every check.

    Raises:
        NoWorldError: if none does within the tries.
    """
    random, form = key.random("world"), FORMS[key.form]
    for _ in range(TRIES):
        draft = form.draw(random, key.level, key.want)
        world = other_world(draft)
        if overlapping(world.things):
            continue
        run = simulate(world)
        if form.judge(draft, run) not in {key.want, -1} or not is_still(world, run):
            continue
        camera = view_of(draft, run, random, scale)
        if camera is None:
            continue
        factual = simulate(replace(world, removed=None)) if world.removed else None
        if factual and factual.first(world.mover, world.removed or "") is None:
            continue
        answer, hidden = answer_of(draft, run, camera, form)
        item = Accepted(key, draft, run, camera, key.want, factual, hidden)
        if answer != key.want or not arrow_fits(item) or not holds(item):
            continue
        canvas = Canvas(item, world)
        if canvas.is_clear():
            return item, canvas
        canvas.close()
    raise NoWorldError(f"{key.id}: no clear world in {TRIES} tries; take another seed than {key.seed}")


def physics_record(world: OtherWorld, form: str) -> dict:
    """What `meta.json` says of the second family alone: how to run the world again."""
    return {
        "family": "other",
        "fixtures": [asdict(f) for f in world.fixtures],
        "physics": {
            "engine": f"mujoco {mujoco.__version__}", "rate": RATE, **asdict(world.matter), "spin": list(world.spin),
            "carry_to": world.carry_to and list(world.carry_to), "fine": FINE.get(form, 1.0),
            "variations": [asdict(v) for v in VARIATIONS],
        },
    }  # fmt: skip


def write_other(folder: Path, key: ItemKey, settings: Settings) -> None:
    """Find an item's world and write all its files into a folder."""
    item, canvas = find_other(key, settings.width / 832)
    clean = canvas.picture(0)
    picture, meta = question_picture(item, clean, None)
    mover = frozenset({item.draft.world.mover})
    pictures = {"image": picture, "clean": clean, "background": canvas.picture(0, mover)}
    pictures |= {f"future_{n}": canvas.picture(n) for n in FUTURE}
    record = {**meta, **physics_record(other_world(item.draft), key.form)}
    write_files(folder, pictures, canvas.maps(), record, settings.quality)
    canvas.close()
