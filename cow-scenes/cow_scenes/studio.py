"""Draws a world with Blender's Cycles on the CPU. The only module that imports `bpy`."""

import tempfile
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix
from PIL import Image

from .accept import Accepted, still, trail_of
from .catalogue import ACCENTS, COLOURS
from .meshes import Part, parts_of
from .raster import table_mesh, turn_matrix
from .room import FLOOR_HALF, Room, room_of
from .world import Thing


def pose_matrix(centre: np.ndarray, turn: np.ndarray, scale: float) -> Matrix:
    """Blender's matrix of an object's pose."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn_matrix(turn) * scale, centre
    return Matrix(matrix.tolist())


def material(name: str, colour: tuple[float, float, float], rough: float) -> bpy.types.Material:
    """A plain glossy material of a linear RGB colour."""
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    shader = made.node_tree.nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value = (*colour, 1)
    shader.inputs["Roughness"].default_value = rough
    return made


def textured(name: str, colour: tuple[float, float, float], stretch: tuple[float, float, float]) -> bpy.types.Material:
    """A material with a slight streaky grain."""
    made = material(name, colour, 0.75)
    nodes, links = made.node_tree.nodes, made.node_tree.links
    place, scale = nodes.new("ShaderNodeTexCoord"), nodes.new("ShaderNodeMapping")
    noise, ramp = nodes.new("ShaderNodeTexNoise"), nodes.new("ShaderNodeValToRGB")
    scale.inputs["Scale"].default_value = stretch
    noise.inputs["Scale"].default_value, noise.inputs["Detail"].default_value = 3.0, 2.0
    for stop, position, factor in zip(ramp.color_ramp.elements, (0.35, 0.65), (0.90, 1.10), strict=True):
        stop.position, stop.color = position, (*(c * factor for c in colour), 1)
    links.new(place.outputs["Object"], scale.inputs["Vector"])
    links.new(scale.outputs["Vector"], noise.inputs["Vector"])
    links.new(noise.outputs["Fac"], ramp.inputs["Fac"])
    links.new(ramp.outputs["Color"], nodes["Principled BSDF"].inputs["Base Color"])
    return made


def add_mesh(name: str, vertices: np.ndarray, triangles: np.ndarray, look: bpy.types.Material, smooth: bool) -> object:
    """A mesh object in the scene; `smooth` rounds edges of less than 40 degrees."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(vertices.tolist(), [], triangles.tolist())
    mesh.materials.append(look)
    if smooth:
        mesh.shade_smooth()
        mesh.set_sharp_from_angle(angle=np.radians(40))
    made = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(made)
    return made


def add_parts(thing: Thing, looks: dict[str, bpy.types.Material]) -> list:
    """All parts of an object; its own colour is the material `main`."""
    main = material(thing.name, COLOURS[thing.colour], 0.35)

    def part_object(part: Part) -> object:
        look = main if part.material == "main" else looks[part.material]
        return add_mesh(thing.name, part.vertices, part.triangles, look, part.smooth)

    return [part_object(part) for part in parts_of(thing.shape)]


def add_light(kind: str, energy: float, at: np.ndarray, size: float) -> None:
    """A lamp at a point that shines at the origin."""
    data = bpy.data.lights.new(kind, kind)
    data.energy = energy
    if kind == "AREA":
        data.size = size
    else:
        data.angle = size
    lamp = bpy.data.objects.new(kind, data)
    lamp.location = tuple(at)
    z = at / np.linalg.norm(at)
    x = np.cross([0.0, 1.0, 0.0], z)
    x = x / np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z], 1)
    lamp.matrix_world = Matrix.Translation(tuple(at)) @ Matrix(rotation.tolist()).to_4x4()
    bpy.context.scene.collection.objects.link(lamp)


class Studio:
    """One item's scene in Blender. Making another Studio in the same process discards the one before."""

    def __init__(self, item: Accepted, samples: int, threads: int) -> None:
        self.item = item
        bpy.ops.wm.read_factory_settings(use_empty=True)
        self.looks = {name: material(name, colour, 0.4) for name, colour in ACCENTS.items()}
        self.set_render(samples, threads)
        self.set_camera()
        self.set_room(room_of(item))
        self.parts = {t.name: add_parts(t, self.looks) for t in item.draft.world.things}
        if item.draft.world.table:
            add_mesh("table", *table_mesh(item.draft.world.table), self.looks["table"], False)

    def set_render(self, samples: int, threads: int) -> None:
        """Cycles with few samples and the denoiser; a fixed seed, so that the same scene gives the same picture."""
        scene, camera = bpy.context.scene, self.item.camera
        scene.render.engine = "CYCLES"
        scene.cycles.device, scene.cycles.samples, scene.cycles.seed = "CPU", samples, 0
        scene.cycles.use_adaptive_sampling = False
        scene.cycles.use_denoising, scene.cycles.denoiser = True, "OPENIMAGEDENOISE"
        scene.cycles.denoising_quality, scene.cycles.denoising_prefilter = "BALANCED", "FAST"
        scene.cycles.max_bounces, scene.cycles.diffuse_bounces, scene.cycles.glossy_bounces = 2, 1, 1
        scene.cycles.caustics_reflective = scene.cycles.caustics_refractive = False
        scene.render.threads_mode, scene.render.threads = "FIXED", threads
        scene.render.resolution_x, scene.render.resolution_y = camera.width, camera.height
        scene.render.resolution_percentage = 100
        scene.render.image_settings.file_format = "PNG"
        scene.view_settings.view_transform = "Filmic"
        scene.view_settings.look = "High Contrast"

    def set_camera(self) -> None:
        """The pinhole camera; Blender's looks along -z with y up."""
        camera, data = self.item.camera, bpy.data.cameras.new("camera")
        data.sensor_fit, data.sensor_width = "HORIZONTAL", 36.0
        data.lens = camera.focal * 36.0 / camera.width
        made = bpy.data.objects.new("camera", data)
        made.matrix_world = Matrix((camera.pose @ np.diag([1.0, -1, -1, 1])).tolist())
        bpy.context.scene.collection.objects.link(made)
        bpy.context.scene.camera = made

    def set_room(self, room: Room) -> None:
        """Floor with grain, two far walls, a soft sun and an even sky."""
        world = bpy.data.worlds.new("sky")
        world.use_nodes = True
        world.node_tree.nodes["Background"].inputs[0].default_value = (0.9, 0.93, 1.0, 1)
        world.node_tree.nodes["Background"].inputs[1].default_value = room.sky
        bpy.context.scene.world = world
        square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * FLOOR_HALF
        two = np.array([[0, 1, 2], [0, 2, 3]])
        add_mesh("floor", square, two, textured("floor", room.floor, room.streak), False)
        look = material("wall", room.wall, 0.9)
        for wall in room.walls:
            add_mesh("wall", room.wall_corners(wall), two, look, False)
        add_light("SUN", room.sun_energy, np.array(room.sun), room.sun_size)

    def place(self, sample: int) -> None:
        """Put every object where it is at a sample; at sample 0 nothing has been taken away yet."""
        for thing in self.item.draft.world.things:
            pose = still(thing) if sample == 0 else (
                self.item.run.centres[thing.name][sample], self.item.run.turns[thing.name][sample]
            )  # fmt: skip
            for part in self.parts[thing.name]:
                part.matrix_world = pose_matrix(*pose, thing.scale)

    def render(self, sample: int) -> Image.Image:
        """The picture (RGB) at a sample."""
        self.place(sample)
        with tempfile.TemporaryDirectory(prefix="cow-scenes-") as folder:
            path = Path(folder) / "picture.png"
            bpy.context.scene.render.filepath = str(path)
            bpy.ops.render.render(write_still=True)
            with Image.open(path) as picture:
                return picture.convert("RGB")

    def render_background(self) -> Image.Image:
        """The picture at t = 0 without the mover and all that comes of it: its shadow, its light on other things."""
        parts = self.parts[self.item.draft.world.mover]
        for part in parts:
            part.hide_render = True
        picture = self.render(0)
        for part in parts:
            part.hide_render = False
        return picture

    def render_trail(self) -> Image.Image:
        """The picture at t = 0 with the mover at its earlier positions too."""
        draft = self.item.draft
        mover = draft.world.thing(draft.world.mover)
        ghosts = []
        for point in trail_of(draft):
            for part in self.parts[mover.name]:
                ghost = bpy.data.objects.new("ghost", part.data)
                ghost.matrix_world = pose_matrix(point, np.array([0, 0, 0, 1.0]), mover.scale)
                bpy.context.scene.collection.objects.link(ghost)
                ghosts.append(ghost)
        picture = self.render(0)
        for ghost in ghosts:
            bpy.data.objects.remove(ghost)
        return picture
