"""Makes one item of the second family: finds its world and its camera, draws it with MuJoCo, writes its files."""

import os
from dataclasses import asdict, replace
from pathlib import Path

# MuJoCo reads this when it is imported. OSMesa draws without a graphics card, the same everywhere.
os.environ["MUJOCO_GL"] = "osmesa"

import mujoco
import numpy as np
from PIL import Image

from ..accept import Accepted, answer_of, before_camera, fall_clear, in_view, overlapping, still, well_seen
from ..camera import Camera, look_at
from ..catalogue import ACCENTS, COLOURS
from ..errors import NoWorldError
from ..forms import Draft
from ..item import question_picture, write_files
from ..maps import id_numbers
from ..meta import FUTURE, box_of, direction_of
from ..plan import ItemKey
from ..raster import placed
from ..settings import Settings
from ..world import Run
from .forms import FORMS
from .looks import Look, as_taken, look_of, pick, rgba
from .physics import RATE, VARIATIONS, OtherWorld, numbers, simulate
from .shapes import shapes

TRIES, VIEWS = 3000, 6
SIZES = ((832, 480), (640, 480), (768, 576), (960, 540), (720, 720), (480, 640), (540, 720))
"""Pixels at `--width` 832."""
FULL_FRAME = 43.27
"""Millimetres: the diagonal of a full-frame sensor."""
LEAST_SIDE = 0.034
"""Smallest side of an object's box over the longer side of the picture."""
LEAST_MAIN, LEAST_OTHER = 0.9, 0.6
"""Shares of their silhouettes that mover and target, and all others, show at t = 0."""
FINE = {"billiards": 0.3}
"""How much smaller the turns of the variations are."""


def srgb(linear: tuple) -> tuple:
    """A linear colour of 0 to 1 as one of 0 to 255 to be shown."""
    return tuple(255 * c ** (1 / 2.2) for c in linear)


def drawn_meshes(world: OtherWorld, random: np.random.Generator) -> tuple[str, str]:
    """Assets and bodies of everything that has an id, each in a finish of its own."""
    assets, bodies = "", ""
    for k, thing in enumerate(world.things):
        shape, shine, geoms = shapes()[thing.shape], random.uniform(0, 1), ""
        shade = random.uniform(0.85, 1.1)
        for i, part in enumerate(shape.parts):
            corners = (part.vertices - (0, 0, shape.height / 2)) * thing.scale
            linear = COLOURS[thing.colour] if part.material == "main" else ACCENTS[part.material]
            colour = rgba(tuple(min(255, c * shade) for c in srgb(linear)))
            assets += (
                f'<mesh name="{k}.{i}" inertia="shell" vertex="{numbers(corners)}" '
                f'face="{" ".join(map(str, part.triangles.ravel()))}"/>'
            )
            geoms += f'<geom type="mesh" mesh="{k}.{i}" material="{k}" rgba="{colour}"/>'
        grain = 'texture="weave"' if thing.shape == "basket" else 'texture="grain"' if random.uniform() < 0.5 else ""
        assets += f'<material name="{k}" {grain} specular="{shine:.3f}" shininess="{shine:.3f}"/>'
        bodies += f'<body name="{thing.name}" mocap="true">{geoms}</body>'
    for fixture in world.fixtures:
        tone = random.uniform(0.35, 0.9) * np.array([255, 240, 220]) * (1, 1, random.uniform(0.65, 1))
        assets += f'<mesh name="{fixture.name}" vertex="{numbers(fixture.corners)}"/>'
        geom = f'<geom type="mesh" mesh="{fixture.name}" material="plain" rgba="{rgba(tuple(tone))}"/>'
        bodies += f'<body name="{fixture.name}">{geom}</body>'
    return assets, bodies


class Canvas:
    """One item's scene as MuJoCo draws it; `poses` are centres and turns by name."""

    def __init__(self, item: Accepted, world: OtherWorld, look: Look) -> None:
        self.item, self.look, camera = item, look, item.camera
        assets, bodies = drawn_meshes(world, item.key.random("finish"))
        right, down, _ = camera.pose[:3, :3].T
        # A sensor of one millimetre per pixel, so that MuJoCo's focal length is in pixels.
        lens = (
            f'<camera name="camera" pos="{numbers(camera.pose[:3, 3])}" xyaxes="{numbers([right, -down])}" '
            f'resolution="{camera.width} {camera.height}" focalpixel="{camera.focal:.9g} {camera.focal:.9g}" '
            f'sensorsize="{camera.width / 1000} {camera.height / 1000}"/>'
        )
        self.model = mujoco.MjModel.from_xml_string(
            f'<mujoco><statistic extent="1" center="0 0 0"/><visual>{look.visual}<map znear="0.02" zfar="200"/>'
            f'<global offwidth="{2 * camera.width}" offheight="{2 * camera.height}"/><quality shadowsize="4096"/>'
            f"</visual><asset>{look.assets}{assets}</asset><worldbody>{look.bodies}{lens}{bodies}</worldbody></mujoco>",
            look.files,
        )
        self.data = mujoco.MjData(self.model)
        self.owners = [self.model.body(b).name for b in self.model.geom_bodyid]
        self.fine, self.plain = (
            mujoco.Renderer(self.model, n * camera.height, n * camera.width) for n in (2, 1)
        )  # fmt: skip

    def pose(self, sample: int) -> None:
        """Put every object where it is at a sample; at sample 0 nothing has been taken away yet."""
        for thing in self.item.draft.world.things:
            run = self.item.run
            at, turn = still(thing) if sample == 0 else (run.centres[thing.name][sample], run.turns[thing.name][sample])
            k = self.model.body(thing.name).mocapid[0]
            self.data.mocap_pos[k], self.data.mocap_quat[k] = at, np.roll(turn, 1)
        mujoco.mj_forward(self.model, self.data)

    def show(self, renderer: mujoco.Renderer, hidden: set[str]) -> np.ndarray:
        """What a renderer gives without some of the objects."""
        renderer.update_scene(self.data, "camera")
        for geom in renderer.scene.geoms[: renderer.scene.ngeom]:
            if self.owners[geom.objid] in hidden:
                geom.pos[:] = 0, 0, -1e4
        return renderer.render().copy()

    def numbered(self, renderer: mujoco.Renderer, hidden: set[str]) -> np.ndarray:
        """The number of the drawn part at each pixel, -1 for none."""
        renderer.enable_segmentation_rendering()
        found = self.show(renderer, hidden)[..., 0]
        renderer.disable_segmentation_rendering()
        return found

    def picture(self, sample: int, hidden: frozenset[str] = frozenset()) -> Image.Image:
        """The picture at a sample, drawn twice as large, before its backdrop."""
        self.pose(sample)
        drawn, parts = self.show(self.fine, set(hidden)), self.numbered(self.fine, set(hidden))
        whole = np.where((parts < 0)[..., None], np.asarray(self.look.backdrop), drawn)
        size = (self.item.camera.width, self.item.camera.height)
        small = np.asarray(Image.fromarray(whole.astype(np.uint8)).resize(size, Image.Resampling.BOX), float)
        return as_taken(small, self.item.key.random("film"), self.item.key.random(f"grain {sample} {sorted(hidden)}"))

    def maps(self) -> tuple[np.ndarray, np.ndarray]:
        """Ids (h, w) uint8 and depth (h, w) in metres at t = 0; infinite where the backdrop is seen."""
        self.pose(0)
        ids, parts = id_numbers(self.item), self.numbered(self.plain, set())
        number = np.array([ids.get(name, 0) for name in [*self.owners, ""]], np.uint8)
        self.plain.enable_depth_rendering()
        depth = self.show(self.plain, set()).astype(float)
        self.plain.disable_depth_rendering()
        return number[parts], np.where(parts < 0, np.inf, depth)

    def is_clear(self) -> bool:
        """At t = 0 mover and target, and the others, show as much of their silhouettes as they have to."""
        ids, draft = self.maps()[0], self.item.draft
        for thing in draft.world.things:
            alone = self.numbered(self.plain, set(self.owners) - {thing.name}) >= 0
            shown = (ids == id_numbers(self.item)[thing.name]).sum() / max(1, alone.sum())
            least = LEAST_MAIN if thing.name in {draft.world.mover, draft.target, draft.via} else LEAST_OTHER
            if shown < least:
                return False
        return True

    def close(self) -> None:
        """Free the renderers' memory."""
        self.fine.close()
        self.plain.close()


def decision(draft: Draft, run: Run) -> int:
    """The sample at which the answer is settled: the touch, or the closest approach."""
    one = draft.via or draft.world.mover
    contact = run.first(one, draft.target)
    if draft.form in {"place", "fall"} or contact:
        return contact.sample if contact and draft.form != "place" else 60 if draft.form == "place" else 15
    return int(np.linalg.norm(run.centres[one] - run.centres[draft.target], axis=1).argmin())


def must_show(draft: Draft, world: OtherWorld, run: Run) -> np.ndarray:
    """Points (n, 3) that have to be inside the picture: everything at t = 0, and the motion until it is settled."""
    mover, end = world.thing(world.mover), decision(draft, run) + 1
    path = run.centres[draft.via or mover.name][:end]
    reach = mover.height / 2
    around = [path + off for off in np.concatenate([np.eye(3), -np.eye(3)]) * reach]
    return np.concatenate([
        *(placed(t, *still(t)) for t in world.things), *(f.corners for f in world.fixtures), *around,
        run.centres[mover.name][: end if draft.via is None else 1],
    ])  # fmt: skip


def arrow_fits(draft: Draft, item: Accepted) -> bool:
    """Whether the longest arrow would stay inside the picture."""
    mover, camera = draft.world.thing(draft.world.mover), item.camera
    box = box_of(camera, mover, *still(mover))
    way = direction_of(item) * (1 if draft.along else -1)
    tip = camera.project(np.array(mover.centre)) + way * (0.4 * min(box[2:] - box[:2]) + 120 * camera.width / 832)
    return not draft.arrow or bool((tip > 4).all() and (tip < np.array([camera.width, camera.height]) - 4).all())


def is_small(draft: Draft, camera: Camera) -> bool:
    """Whether an object is too small for its picture, which may be a portrait."""
    boxes = [box_of(camera, t, *still(t)) for t in draft.world.things]
    return min(min(box[2:] - box[:2]) for box in boxes) < LEAST_SIDE * max(camera.width, camera.height)


def view_of(draft: Draft, world: OtherWorld, run: Run, random: np.random.Generator, scale: float) -> Camera | None:
    """A camera that sees everything, as near as it can be or somewhat farther; None after a few tries."""
    points = must_show(draft, world, run)
    for _ in range(VIEWS):
        width, height = (round(side * scale) for side in pick(random, SIZES))
        focal = np.exp(random.uniform(np.log(24), np.log(85))) / FULL_FRAME * np.hypot(width, height)
        pitch, roll = np.radians(random.uniform(0, 60)), np.radians(random.uniform(-5, 5) * (random.uniform() < 0.15))
        yaw = random.uniform(0, 2 * np.pi) if draft.view_yaw is None else draft.view_yaw
        back = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
        middle, edge = (points.min(0) + points.max(0)) / 2, 0.02 * width

        def camera_at(away: float) -> Camera:
            pose = look_at(middle + back * away, middle)  # noqa: B023
            c, s = np.cos(roll), np.sin(roll)  # noqa: B023
            pose[:3, :3] = pose[:3, :3] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
            return Camera(float(focal), width, height, pose)  # noqa: B023

        def sees_all(camera: Camera) -> bool:
            pixels = camera.project(points)
            far = camera.to_camera(points)[:, 2].min() > 0.3
            return bool(far and (pixels > edge).all() and (pixels < (camera.width - edge, camera.height - edge)).all())  # noqa: B023

        near, away = 0.0, 60.0
        for _ in range(20):
            half = (near + away) / 2
            near, away = (near, half) if sees_all(camera_at(half)) else (half, away)
        camera = camera_at(away * random.uniform(1.0, 1.2))
        if camera.pose[2, 3] < 0.03 or not sees_all(camera) or not in_view(draft, camera) or is_small(draft, camera):
            continue
        if fall_clear(draft, camera) and well_seen(draft, camera) and before_camera(draft, run, camera):
            return camera
    return None


def holds(draft: Draft, world: OtherWorld, item: Accepted) -> bool:
    """Whether the answer is the same under all variations."""
    form = FORMS[draft.form]
    for variation in VARIATIONS:
        other = replace(draft, world=world.varied(variation, FINE.get(draft.form, 1.0)))
        run = simulate(other.world)
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
        world = draft.world
        if overlapping(world.things):
            continue
        run = simulate(world)
        if form.judge(draft, run) not in {key.want, -1} or not is_still(world, run):
            continue
        camera = view_of(draft, world, run, random, scale)
        if camera is None:
            continue
        factual = simulate(replace(world, removed=None)) if world.removed else None
        if factual and factual.first(world.mover, world.removed) is None:
            continue
        answer, hidden = answer_of(draft, run, camera, form)
        item = Accepted(key, draft, run, camera, key.want, factual, hidden)
        if answer != key.want or not arrow_fits(draft, item) or not holds(draft, world, item):
            continue
        canvas = Canvas(item, world, surroundings(item))
        if canvas.is_clear():
            return item, canvas
        canvas.close()
    raise NoWorldError(f"{key.id}: no clear world in {TRIES} tries; take another seed than {key.seed}")


def surroundings(item: Accepted) -> Look:
    """The look of an item's surroundings, which are beyond all that moves."""
    names, forward = {t.shape for t in item.draft.world.things}, item.camera.pose[:2, 2]
    extent = np.concatenate([c[c[:, 2] > -1, :2] for c in item.run.centres.values()])
    reach = max(0.4, *(float(np.hypot(*t.centre[:2])) + t.radius for t in item.draft.world.things))
    size = (2 * item.camera.width, 2 * item.camera.height)
    yaw = float(np.arctan2(forward[1], forward[0]))
    pitch = float(np.degrees(np.arcsin(-item.camera.pose[2, 2])))
    return look_of(item.key.random("look"), reach, extent, yaw, size, pitch, frozenset(names))


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
    world = item.draft.world
    write_files(folder, pictures, canvas.maps(), {**meta, **physics_record(world, key.form)}, settings.quality)
    canvas.close()
