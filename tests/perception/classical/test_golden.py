"""What is measured in a few pictures, in figures: a change of any step between a picture and its things shows here."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from conftest import DATA, example
from drawn import Image, ball, block, bowl, floor, jpeg, trail

from cow_service.media.masks import pieces_of
from cow_service.perception.classical.forms import log_ratio, looks_like
from cow_service.perception.classical.openings import measure_opening
from cow_service.perception.classical.segmentation import mask_from_bbox, mask_from_point
from cow_service.perception.observation import Observation, look

RED, BLUE, BROWN, WHITE = (200, 40, 40), (50, 80, 200), (139, 90, 43), (240, 240, 240)


def shelf() -> Image:
    """Larger than images are searched at: things with tops, wheels and handles, before each other and at the border."""
    image = floor(960, 640, 160)
    image = ball(block(image, (60, 80, 190, 260), (60, 180, 190)), (150, 60), 50, (235, 130, 40))
    image = block(block(image, (640, 130, 860, 240), (120, 60, 170)), (680, 238, 820, 270), (18, 18, 18))
    image = ball(block(image, (300, 150, 520, 330), (205, 205, 205)), (410, 120), 52, WHITE)
    image = bowl(image, (150, 420), 90, 70, (50, 150, 50))
    image = block(image, (400, 560, 560, 640), (225, 130, 165))
    cv2.fillPoly(image, [np.array([[560, 300], [575, 300], [600, 470], [530, 470]], np.int32)], (225, 200, 50))
    cv2.ellipse(image, (800, 450), (30, 24), 0, 0, 360, BLUE, 12, cv2.LINE_AA)
    image[400:540, 700:790] = BLUE
    cv2.fillPoly(image, [np.array([[360, 380], [410, 540], [310, 540]], np.int32)], (172, 172, 172), cv2.LINE_AA)
    cv2.rectangle(image, (600, 560), (700, 630), (230, 40, 40), 4)
    cv2.arrowedLine(image, (240, 60), (300, 30), (0, 0, 0), 6, cv2.LINE_AA, tipLength=0.3)
    return jpeg(image)


def thrown() -> Image:
    """A faded trail whose positions have shadows on the floor."""
    image, places = (
        floor(640, 400, 150) * np.array([1.1, 0.95, 0.8]),
        [(160.0, 150.0), (226.0, 110.0), (292.0, 106.0), (358.0, 138.0)],
    )
    ys, xs = np.mgrid[:400, :640] + 0.5
    for x, _ in places:
        image *= 1 - 0.2 * np.clip((1.06 - np.hypot((xs - x - 20) / 26, (ys - 300) / 11)) / 0.12, 0, 1)[..., None]
    return jpeg(trail(image.astype(np.uint8), places, [26.0] * 4, (220, 120, 30), [0.35, 0.5, 0.75, 1.0]), 95)


def drawing() -> Image:
    """Seen from the side: a ball on a table, and a slope."""
    image = np.full((400, 640, 3), 255, np.uint8)
    image[330:] = (40, 160, 60)
    image[210:226, 80:320] = image[210:328, 100:114] = image[210:328, 290:304] = BROWN
    cv2.fillPoly(image, [np.array([(400, 329), (600, 329), (600, 200)])], BLUE, cv2.LINE_AA)
    cv2.circle(image, (180, 188), 20, RED, cv2.FILLED, cv2.LINE_AA)
    return image


PICTURES: dict[str, Callable[[], Image]] = {
    name: lambda name=name: example(name).pixels("image.jpg") for name in ("ball-and-mug", "thrown-ball")
} | {
    "vase": lambda: np.ascontiguousarray(cv2.imread(str(DATA / "half_vase.jpg"))[..., ::-1]),
    "shelf": shelf,
    "thrown": thrown,
    "drawing": drawing,
}


def figures(scene: Observation) -> list[tuple]:
    """A row for whatever was measured: its name and numbers, in px and shares."""
    rows: list[tuple] = []
    for region in scene.things:
        flags = region.is_disc, region.is_hidden, region.roundness, region.confidence, log_ratio(region, "vase")
        rows.append((f"{region.colour} {looks_like(region)}", *region.bbox, region.mask.area, *flags))
    rows += [("arrow", *arrow.tail, *arrow.tip, np.count_nonzero(arrow.mask), arrow.fit) for arrow in scene.arrows]
    rows += [("box", *box.bbox, np.count_nonzero(box.mask)) for box in scene.boxes]
    rows += [("position", *p.centre, p.radius, p.opacity) for found in scene.trails for p in found.positions]
    changed = (scene.clean != scene.image).any(axis=2)
    if changed.any():
        colours = scene.clean[changed]
        rows.append(("painted", len(colours), *colours.mean(axis=0), colours.std()))
    if scene.side_view is not None:
        shapes = scene.side_view.shapes
        return rows + [("piece", *np.ptp(each, axis=0)) for shape in shapes for each in pieces_of(shape)]
    rows.append(("edges", np.hypot(*(scene.segments[:, :2] - scene.segments[:, 2:]).T).sum()))
    if shadow := scene.shadow_below(scene.things[-1].bbox):
        rows.append(("shadow", *shadow.centre, *shadow.spread, shadow.shade))
    for region in scene.things[1:2]:
        opening, cut = measure_opening(region.mask), mask_from_bbox(scene.clean, region.bbox)
        rows.append(("opening", opening.inner, opening.bottom, opening.rim is not None))
        rows.append(("cut", np.count_nonzero(cut), np.count_nonzero(mask_from_point(scene.clean, region.centre))))
    return rows


MEASURED = {
    "ball-and-mug": [
        ("white mug", 325, 257, 413, 348, 5632, 0, 0, 0.5955, 0.5261, -6.07),
        ("blue mug", 440, 216, 522, 299, 4868, 0, 0, 0.7335, 1, -7.222),
        ("yellow ball", 245, 195, 305, 255, 2743, 1, 0, 0.9546, 1, -14.63),
        ("arrow", 241.2, 217.1, 146.9, 199.7, 1704, 0.8682),
        ("painted", 1701, 159.1, 154.9, 152.2, 3.948),
        ("edges", 2537),
        ("opening", 0.7032, 0.7292, 1),
        ("cut", 4661, 4994),
    ],
    "thrown-ball": [
        ("white None", 496, 203, 590, 290, 6717, 0, 0, 0.6949, 0.6165, -9.131),
        ("blue None", 351, 174, 431, 246, 4976, 0, 0, 0.7278, 1, -9.825),
        ("pink ball", 198, 23, 270, 94, 4045, 1, 0, 0.961, 1, -14.63),
        ("arrow", 241.4, 54.84, 325.2, 10.43, 1500, 0.9144),
        ("painted", 1500, 150.7, 133.4, 129.9, 17.77),
        ("edges", 2215),
        ("shadow", 352.5, 273.2, 312.9, 25.76, -5.265, 0.07065),
        ("opening", 0.9184, 0.9661, 1),
        ("cut", 4818, 4978),
    ],
    "vase": [
        ("blue None", 174, 330, 385, 480, 26340, 0, 0, 0.6036, 0.9969, -7.92),
        ("purple ball", 522, 24, 613, 116, 6567, 1, 0, 0.9663, 1, -14.63),
        ("white car", 263, 220, 327, 293, 2790, 0, 0, 0.5564, 0.6875, -2.744),
        ("white car", 263, 151, 349, 177, 2021, 0, 0, 0.33, 1, -4.074),
        ("arrow", 614, 74.41, 733, 85.62, 1855, 0.8926),
        ("painted", 1850, 129.1, 127.2, 125.3, 8.225),
        ("edges", 2621),
        ("opening", 0.8789, 0.8182, 1),
        ("cut", 6411, 6598),
    ],
    "shelf": [
        ("purple None", 639, 130, 861, 270, 28550, 0, 0, 0.5996, 1, -6.478),
        ("cyan None", 60, 79, 191, 261, 21760, 0, 0, 0.56, 1, -9.32),
        ("white None", 300, 68, 519, 201, 18520, 0, 0, 0.4623, 1, -0.2078),
        ("green bowl", 60, 373, 242, 514, 18510, 0, 0, 0.7034, 1, -7.419),
        ("blue mug", 699, 400, 838, 541, 14440, 0, 0, 0.6285, 1, -6.822),
        ("pink None", 399, 559, 561, 640, 13110, 0, 0, 0.5146, 0.9941, -4.461),
        ("white cone", 311, 389, 411, 542, 9006, 0, 0, 0.3987, 0.4901, -7.08),
        ("orange ball", 99, 9, 201, 109, 7973, 1, 0, 0.9679, 1, -14.64),
        ("yellow cone", 531, 300, 600, 471, 7600, 0, 0, 0.3014, 1, -4.861),
        ("arrow", 237.9, 61.1, 302.6, 28.75, 1520, 0.884),
        ("box", 601.1, 561.4, 698.6, 628.9, 4053),
        ("painted", 5472, 161.9, 161.7, 162, 3.496),
        ("edges", 5260),
        ("opening", 0.93, 0.7, 0),
        ("cut", 21310, 21540),
    ],
    "thrown": [
        ("orange ball", 331, 111, 384, 164, 2180, 1, 0, 0.9493, 1, -14.62),
        ("position", 159.9, 150, 25.99, 0.3317),
        ("position", 226, 110, 25.95, 0.4726),
        ("position", 292, 106.1, 25.95, 0.732),
        ("position", 357.9, 138, 25.97, 1),
        ("painted", 7377, 160.5, 138.5, 116.3, 18.17),
        ("edges", 613.2),
    ],
    "drawing": [
        ("blue cone", 403, 199, 602, 329, 13120, 0, 0, 0.2946, 1, -5.13),
        ("orange None", 80, 210, 320, 328, 6696, 0, 0, 0.123, 1, 0.1112),
        ("red ball", 160, 168, 201, 209, 1313, 1, 0, 0.961, 1, -14.63),
        ("piece", 198, 129),
        ("piece", 240, 16),
        ("piece", 14, 102),
        ("piece", 14, 102),
        ("piece", 40, 40),
    ],
}


@pytest.mark.parametrize("name", PICTURES)
def test_what_is_measured_in_a_picture(name: str) -> None:
    found = figures(look(PICTURES[name](), trails=name == "thrown"))
    assert [row[0] for row in found] == [row[0] for row in MEASURED[name]]
    for row, expected in zip(found, MEASURED[name], strict=True):
        assert row[1:] == pytest.approx(expected[1:], rel=0.004, abs=0.004), row
