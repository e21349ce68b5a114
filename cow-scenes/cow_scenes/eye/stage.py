"""The stage: one MuJoCo model with a room, its furniture and two dozen things, of which many pictures are drawn.

To compile shapes and textures takes longer than to draw, so a stage serves a dozen pictures. For each of them
everything is moved, sized and dressed anew.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from .meshes import Part, Random
from .shapes import any_shape
from .skins import ROOMS, SKINS, drawn_from
from .textures import colour

WIDTH, HEIGHT = 640, 384
THINGS, SKIN_COUNT, PLAIN_COUNT, ROOM_COUNT, LIGHTS = 26, 16, 32, 8, 3
NEAR, FAR = 0.03, 40.0
AWAY = np.array([0.0, 0.0, -90.0])
"""Where nobody sees what a picture does not show."""
PROPS = {
    "floor": 1, "table": 1, "leg": 4, "apron": 4, "rail": 4, "overhang": 4, "cloth": 1, "plinth": 2, "board": 6,
    "wall": 3, "skirting": 3, "panel": 5, "cupboard": 6, "picture": 5, "rug": 4, "paper": 6, "stripe": 6, "disc": 4,
}  # fmt: skip
"""How many of each prop a stage has. A prop is a box, but for the floor (a plane) and discs (cylinders)."""


@dataclass(frozen=True)
class Extent:
    """How large a thing is when it stands: radius about its axis and corners of its box, in metres."""

    radius: float
    low: np.ndarray
    high: np.ndarray

    @property
    def height(self) -> float:
        """Metres above what it stands on."""
        return float(self.high[2])


def quaternion(matrix: np.ndarray) -> np.ndarray:
    """A rotation matrix as MuJoCo's quaternion."""
    made = np.zeros(4)
    mujoco.mju_mat2Quat(made, np.ascontiguousarray(matrix, float).ravel())
    return made


def add_texture(spec: mujoco.MjSpec, name: str, pixels: np.ndarray) -> None:
    """A texture and a material that shows it."""
    texture = spec.add_texture()
    texture.name, texture.type = name, mujoco.mjtTexture.mjTEXTURE_2D
    texture.width, texture.height, texture.nchannel = pixels.shape[1], pixels.shape[0], 3
    texture.data = np.ascontiguousarray(pixels).tobytes()


def add_materials(spec: mujoco.MjSpec, random: Random) -> None:
    """`room` materials measure their texture in metres; `skin` ones wrap it around; `plain` ones have none."""
    for kind, count, makers in (("room", ROOM_COUNT, ROOMS), ("skin", SKIN_COUNT, SKINS)):
        for k in range(count):
            add_texture(spec, f"{kind}{k}", drawn_from(random, makers))
            material = spec.add_material()
            material.name, roles = f"{kind}{k}", list(material.textures)
            roles[mujoco.mjtTextureRole.mjTEXROLE_RGB] = f"{kind}{k}"
            material.textures, material.texuniform = roles, kind == "room"
    for k in range(PLAIN_COUNT):
        spec.add_material().name = f"plain{k}"
    sky = spec.add_texture()
    sky.name, sky.type, sky.width, sky.height = "sky", mujoco.mjtTexture.mjTEXTURE_SKYBOX, 64, 384
    sky.builtin = mujoco.mjtBuiltin.mjBUILTIN_GRADIENT
    sky.rgb1, sky.rgb2 = colour(random) / 255, colour(random) / 255


def add_props(spec: mujoco.MjSpec) -> None:
    """The room's geoms, by name and number."""
    kinds = {"floor": mujoco.mjtGeom.mjGEOM_PLANE, "disc": mujoco.mjtGeom.mjGEOM_CYLINDER}
    for name, count in PROPS.items():
        for k in range(count):
            geom = spec.worldbody.add_geom()
            geom.name, geom.type = f"{name}{k}", kinds.get(name, mujoco.mjtGeom.mjGEOM_BOX)
            geom.size, geom.material = [20, 20, 0.4] if name == "floor" else [0.1, 0.1, 0.1], "plain0"
            geom.contype = geom.conaffinity = 0


def add_thing(spec: mujoco.MjSpec, number: int, parts: list[Part], size: float) -> Extent:
    """A body whose parts of one slot are one mesh; its half height or its radius is `size`."""
    corners = np.concatenate([part.vertices for part in parts])
    radius = float(np.hypot(corners[:, 0], corners[:, 1]).max())
    scale = size / max(radius, corners[:, 2].max() / 2)
    body = spec.worldbody.add_body()
    body.name = f"thing{number}"
    for slot in sorted({part.slot for part in parts}):
        chosen = [part for part in parts if part.slot == slot]
        starts = np.cumsum([0, *(len(part.vertices) for part in chosen[:-1])])
        mesh = spec.add_mesh()
        mesh.name, mesh.inertia = f"mesh{number}.{slot}", mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        mesh.uservert = (np.concatenate([part.vertices for part in chosen]) * scale).ravel()
        faces = np.concatenate([part.faces + start for part, start in zip(chosen, starts, strict=True)])
        mesh.userface = faces.astype(np.int32).ravel()
        mesh.usertexcoord = np.concatenate([part.texture for part in chosen]).astype(np.float32).ravel()
        geom = body.add_geom()
        geom.type, geom.meshname, geom.material = mujoco.mjtGeom.mjGEOM_MESH, mesh.name, "plain0"
        geom.contype = geom.conaffinity = 0
    return Extent(radius * scale, corners.min(0) * scale, corners.max(0) * scale)


def new_spec() -> mujoco.MjSpec:
    """An empty model with the sizes and the quality that pictures need."""
    spec = mujoco.MjSpec()
    look = spec.visual
    look.global_.offwidth, look.global_.offheight = WIDTH, HEIGHT
    # Edges are softened by drawing a picture several times at shifted pixels: half as dear as four samples per pixel.
    look.quality.shadowsize, look.quality.offsamples, look.quality.numquads = 1024, 0, 10
    look.map.znear, look.map.zfar = NEAR, FAR
    return spec


class Stage:
    """A model to be arranged by its arrays, and the means to draw it. Free it with `close`."""

    def __init__(self, random: Random) -> None:
        spec = new_spec()
        add_materials(spec, random)
        add_props(spec)
        sizes = np.exp(random.uniform(np.log(0.026), np.log(0.2), THINGS))
        self.extents = [add_thing(spec, k, any_shape(random), size) for k, size in enumerate(sizes)]
        for k in range(LIGHTS):
            light = spec.worldbody.add_light()
            light.name, light.castshadow = f"light{k}", k < 2
        spec.worldbody.add_camera().name = "camera"
        self.model = model = spec.compile()
        model.stat.extent, model.stat.center[:], model.geom_sameframe[:] = 1, 0, 0
        self.data = mujoco.MjData(model)
        self.props = {model.geom(i).name: i for i in range(model.ngeom) if model.geom_bodyid[i] == 0}
        self.bodies = [model.body(f"thing{k}").id for k in range(THINGS)]
        names = [model.mat(i).name for i in range(model.nmat)]
        self.materials = {
            kind: [i for i, name in enumerate(names) if name.startswith(kind)] for kind in ("room", "skin", "plain")
        }
        self.scene = mujoco.MjvScene(model, 500)
        self.context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self.context)
        self.camera = mujoco.MjvCamera()
        self.camera.type, self.camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0
        self.view = mujoco.MjrRect(0, 0, WIDTH, HEIGHT)

    def clear(self) -> None:
        """Take everything out of sight."""
        for geom in self.props.values():
            self.model.geom_pos[geom] = AWAY
        for body in self.bodies:
            self.model.body_pos[body] = AWAY

    def put(self, name: str, at: np.ndarray, size: tuple, turn: np.ndarray, material: int) -> None:
        """Show a prop: its centre, half sizes, rotation and material."""
        geom = self.props[name]
        self.model.geom_pos[geom], self.model.geom_quat[geom] = at, quaternion(turn)
        self.model.geom_size[geom, : len(size)] = size
        self.model.geom_matid[geom] = material

    def stand(self, number: int, at: np.ndarray, turn: np.ndarray) -> None:
        """Show a thing: where its foot is, and how it is turned."""
        self.model.body_pos[self.bodies[number]], self.model.body_quat[self.bodies[number]] = at, quaternion(turn)

    def update(self, shift: tuple[float, float] = (0.0, 0.0)) -> None:
        """Bring the scene up to date with the model; `shift` moves the picture by parts of a pixel."""
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        self.model.geom_group[:] = np.where(self.data.geom_xpos[:, 2] < AWAY[2] / 2, 5, 0)
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self.model, self.data, mujoco.MjvOption(), None, self.camera, everything, self.scene)
        for eye in self.scene.camera:
            pixel = (eye.frustum_top - eye.frustum_bottom) / HEIGHT
            eye.frustum_center += shift[0] * pixel
            eye.frustum_top += shift[1] * pixel
            eye.frustum_bottom += shift[1] * pixel

    def flags(self, *, shadow: bool, numbers: bool) -> None:
        """Whether shadows are drawn, and whether geoms are drawn as their numbers."""
        for flag, value in (
            (mujoco.mjtRndFlag.mjRND_SHADOW, shadow), (mujoco.mjtRndFlag.mjRND_REFLECTION, not numbers),
            (mujoco.mjtRndFlag.mjRND_SEGMENT, numbers), (mujoco.mjtRndFlag.mjRND_IDCOLOR, numbers),
        ):  # fmt: skip
            self.scene.flags[flag] = value

    def render(self, *, shadow: bool = True, halved: bool = False) -> np.ndarray:
        """The picture (h, w, 3) uint8 of the scene as it was last updated, or one of half the size."""
        self.flags(shadow=shadow, numbers=False)
        width, height = (WIDTH // 2, HEIGHT // 2) if halved else (WIDTH, HEIGHT)
        pixels, view = np.zeros((height, width, 3), np.uint8), mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(view, self.scene, self.context)
        mujoco.mjr_readPixels(pixels, None, view, self.context)
        return pixels[::-1]

    def geoms(self) -> tuple[np.ndarray, np.ndarray]:
        """The geom at each pixel (h, w), -1 for none, and the depth (h, w) in metres along the optical axis."""
        self.flags(shadow=False, numbers=True)
        pixels, depth = np.zeros((HEIGHT, WIDTH, 3), np.uint8), np.zeros((HEIGHT, WIDTH), np.float32)
        mujoco.mjr_render(self.view, self.scene, self.context)
        mujoco.mjr_readPixels(pixels, depth, self.view, self.context)
        number = pixels[::-1].astype(np.int32) @ np.array([1, 256, 65536])
        geom_of = np.full(self.scene.ngeom + 1, -1)
        for drawn in self.scene.geoms[: self.scene.ngeom]:
            if drawn.objtype == mujoco.mjtObj.mjOBJ_GEOM and drawn.segid >= 0:
                geom_of[drawn.segid + 1] = drawn.objid
        return geom_of[np.clip(number, 0, self.scene.ngeom)], NEAR / (1 - depth[::-1] * (1 - NEAR / FAR))

    def close(self) -> None:
        """Free the buffers of the picture."""
        self.context.free()
