"""Draws an item of the second family with MuJoCo: its pictures, its ids and its depth."""

import mujoco
import numpy as np
from PIL import Image

from ..accept import Accepted, still
from ..catalogue import ACCENTS, COLOURS
from ..maps import id_numbers
from .looks import Look, as_taken, look_of, rgba
from .physics import OtherWorld, numbers
from .shapes import shapes

LEAST_MAIN, LEAST_OTHER = 0.9, 0.6
"""Shares of their silhouettes that mover and target, and all others, show at t = 0."""


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


def look_at_item(item: Accepted) -> Look:
    """The look of an item's surroundings, which are beyond all that moves."""
    names, forward = {t.shape for t in item.draft.world.things}, item.camera.pose[:2, 2]
    extent = np.concatenate([c[c[:, 2] > -1, :2] for c in item.run.centres.values()])
    reach = max(0.4, *(float(np.hypot(*t.centre[:2])) + t.radius for t in item.draft.world.things))
    size = (2 * item.camera.width, 2 * item.camera.height)
    yaw = float(np.arctan2(forward[1], forward[0]))
    pitch = float(np.degrees(np.arcsin(-item.camera.pose[2, 2])))
    return look_of(item.key.random("look"), reach, extent, yaw, size, pitch, frozenset(names))


class Canvas:
    """One item's scene as MuJoCo draws it; `poses` are centres and turns by name."""

    def __init__(self, item: Accepted, world: OtherWorld) -> None:
        self.item, self.look, camera = item, look_at_item(item), item.camera
        assets, bodies = drawn_meshes(world, item.key.random("finish"))
        right, down, _ = camera.pose[:3, :3].T
        # A sensor of one millimetre per pixel, so that MuJoCo's focal length is in pixels.
        lens = (
            f'<camera name="camera" pos="{numbers(camera.pose[:3, 3])}" xyaxes="{numbers([right, -down])}" '
            f'resolution="{camera.width} {camera.height}" focalpixel="{camera.focal:.9g} {camera.focal:.9g}" '
            f'sensorsize="{camera.width / 1000} {camera.height / 1000}"/>'
        )
        self.model = mujoco.MjModel.from_xml_string(
            f'<mujoco><statistic extent="1" center="0 0 0"/><visual>{self.look.visual}<map znear="0.02" zfar="200"/>'
            f'<global offwidth="{2 * camera.width}" offheight="{2 * camera.height}"/><quality shadowsize="4096"/>'
            f"</visual><asset>{self.look.assets}{assets}</asset><worldbody>{self.look.bodies}{lens}{bodies}</worldbody></mujoco>",
            self.look.files,
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
