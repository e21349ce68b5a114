"""Scenes whose truth is known, and clips of them as a generator is given them, without readers, physics or service."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from drawn import ball, block, floor

from cow_service.generators.base import GeneratorInput
from cow_service.generators.cutout import CutoutOptions
from cow_service.perception.observation import look
from cow_service.physics.camera import FloorCamera
from cow_service.records import Grounding, LocatedObject, Motion, Trajectory
from cow_service.stages.generation import scene_of

RED, BLUE, GREEN = (210, 20, 20), (50, 80, 200), (30, 160, 60)
CENTRE, RADIUS = (160.0, 200.0), 40.0
ESTIMATE = {
    "focal": 640, "pitch": 30, "roll": 0, "height": 1.5, "source": "request",
    "deviations": {"focal": 0, "pitch": 0, "roll": 0, "height": 0},
}  # fmt: skip


def ignore(done: float) -> None:
    """There is no listener."""


def shot(image, points, scale=None, depths=None, clean: bool = True, bbox=None, named=(), **more) -> GeneratorInput:
    """A clip of what is at `CENTRE`, or in a box, along points (px), without a camera."""
    seen = look(image)
    bbox = seen.mask_at(CENTRE).bbox if bbox is None else bbox
    others = tuple(LocatedObject(object=f"thing {i}", bbox=box) for i, box in enumerate(named))
    middle = ((bbox[0] + bbox[2]) / 2, (bbox[1] + bbox[3]) / 2)
    grounding = Grounding(object="thing", point=middle, bbox=bbox, others=others, source="request")
    motion = Motion.model_validate(
        {"kind": "linear", "direction": (1, 0), "cue": "request", "speed": 1, "sentence": "",
         "metres_per_pixel": {"value": 0.01, "source": "default"}, "source": "request"}
    )  # fmt: skip
    count = len(points)
    depths = [1.0] * count if depths is None else depths
    path = {
        "states": [(0, 0, z, 0, 0, 0) for z in depths], "points": points, "visible": [True] * count,
        "scale": [1.0] * count if scale is None else scale, "tracks": [points],
    }  # fmt: skip
    trajectory = Trajectory.model_validate({"fps": 16, "paths": [path], "anchors": []} | more)
    obstacles, scene = seen.obstacles(bbox, others), scene_of(seen, grounding, trajectory)
    return GeneratorInput(scene, grounding, motion, trajectory, obstacles, 0, CutoutOptions(clean_cues=clean))


def line(frames: int, dx: float, dy: float = 0.0) -> list[tuple[float, float]]:
    return [(CENTRE[0] + i * dx, CENTRE[1] + i * dy) for i in range(frames)]


def shaded(image, ellipses) -> np.ndarray:
    """The image with soft dark ellipses: centre, half axes (px) and the share of light taken away."""
    ys, xs = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
    result = image.astype(float)
    for (x, y), (a, b), share in ellipses:
        radius = np.hypot((xs - x) / a, (ys - y) / b)
        result *= 1 - share * np.clip((1.1 - radius) / 0.2, 0, 1)[..., None]
    return np.clip(result, 0, 255).astype(np.uint8)


@dataclass
class World:
    """Things on a floor that a camera sees. Coordinates: metres to the right, above the floor, and ahead."""

    image: np.ndarray

    def __post_init__(self) -> None:
        trajectory = Trajectory.model_validate(
            {"fps": 16, "camera": ESTIMATE, "anchors": [],
             "paths": [{"states": [], "points": [], "visible": [], "scale": [], "tracks": []}]}
        )  # fmt: skip
        assert trajectory.camera is not None
        self.camera = FloorCamera.of(trajectory.camera, 640, 400)
        self.bodies: list[dict] = []
        self.paths: list[dict] = []

    def at(self, *places) -> np.ndarray:
        return self.camera.from_floor(np.array(places, float))

    def pixel(self, place) -> tuple[float, float]:
        x, y = self.camera.project(self.at(place))[0]
        return float(x), float(y)

    def radius(self, place, metres: float) -> float:
        return metres * 640 / float(self.at(place)[0, 2])

    def add(self, bbox, place, shape="box", support="floor", size=0.3, path=None, rotation=()) -> None:
        self.bodies.append(
            {"object": f"body {len(self.bodies)}", "bbox": bbox, "shape": shape, "size": (size,) * 3,
             "position": tuple(self.at(place)[0]), "support": support, "source": "request", "confidence": 1}
        )  # fmt: skip
        if path is not None:
            positions = self.at(*path)
            points = [(float(x), float(y)) for x, y in self.camera.project(positions)]
            self.paths.append(
                {"body": len(self.bodies) - 1, "states": [(*p, 0, 0, 0) for p in positions], "points": points,
                 "visible": [True] * len(path), "scale": [float(positions[0, 2] / p[2]) for p in positions],
                 "rotation": rotation, "tracks": []}
            )  # fmt: skip

    def ball(self, place, rgb, radius=0.15, **rest) -> tuple[float, float, float]:
        (x, y), r = self.pixel(place), self.radius(place, radius)
        self.image = ball(self.image, (x, y), r, rgb)
        self.add((x - r, y - r, x + r, y + r), place, shape="sphere", size=2 * radius, **rest)
        return x, y, r

    def block(self, place, rgb, **rest) -> tuple[float, float, float]:
        (x, y), r = self.pixel(place), self.radius(place, 0.15)
        bbox = (round(x - r), round(y - r), round(x + r), round(y + r))
        self.image = block(self.image, bbox, rgb)
        self.add(bbox, place, **rest)
        return x, y, r

    def filmed(self, **more) -> GeneratorInput:
        first = self.bodies[0]
        given = shot(
            self.image, self.paths[0]["points"], bbox=first["bbox"], named=[body["bbox"] for body in self.bodies[1:]],
            paths=self.paths, bodies=self.bodies, camera=ESTIMATE, law="contact", **more,
        )  # fmt: skip
        named = given.obstacles[: len(self.bodies) - 1]
        assert [o.bbox for o in named] == [tuple(map(float, body["bbox"])) for body in self.bodies[1:]]
        return replace(given, obstacles=named)


def rolling(frames: int = 9) -> GeneratorInput:
    """A red ball that rolls to the right, in front of a blue block."""
    world = World(floor())
    way = [(-0.6 + 0.1 * i, 0.15, 2.6) for i in range(frames)]
    world.ball(way[0], RED, path=way)
    world.block((0.5, 0.15, 3.0), BLUE)
    return world.filmed()
