"""Objects that a request gives: by box, point or mask, before what the reader finds; and cuts that are refused."""

from __future__ import annotations

import base64

import cv2
import numpy as np
import pytest
from drawn import ball, block, floor, png_bytes
from refusals import refused
from runs import run_of

from cow_service.media.images import decode_own, encode_png
from cow_service.readers.base import ReadResult
from cow_service.records import GroundingRequest, ObjectRequest, Reading
from cow_service.requests import ImageArtifact, SimulateRequest
from cow_service.service import Service
from cow_service.stages.grounding import ground, look_again

MOVER = (160, 160, 240, 240)
CUBE = (400, 220, 480, 300)


@pytest.fixture(scope="module")
def pixels() -> np.ndarray:
    return block(ball(floor(640, 400), (200, 200), 40, (200, 30, 30)), CUBE, (30, 60, 200))


class OneReader:
    source = "embedded"
    heeds_objections = False

    def read(self, given):
        others = (ObjectRequest(object="blue cube", bbox=CUBE), ObjectRequest(object="vase", bbox=(20, 300, 60, 390)))
        return ReadResult(Reading(grounding=GroundingRequest(object="red ball", bbox=MOVER), objects=others))


def kept(run, mask: np.ndarray) -> dict[str, str]:
    return {"artifact": run.backends.artifacts.put(encode_png(mask), "image/png").sha256}


def circle(centre: tuple[int, int], radius: int, size: tuple[int, int] = (640, 400)) -> np.ndarray:
    return cv2.circle(np.zeros(size[::-1], np.uint8), centre, radius, 255, -1)


def test_objects_stand_before_what_the_reader_finds_and_the_mover_is_none(pixels: np.ndarray) -> None:
    crate = {"object": "crate", "bbox": CUBE, "role": "obstacle", "shape": "box", "size": 0.3, "stands_on": "floor"}
    result = ground(run_of(pixels, reader=OneReader, objects=[crate, {"object": "ball", "bbox": MOVER}]))
    assert any("objects.1" in warning for warning in result.warnings)
    asked = result.value
    assert [(other.object, other.source) for other in asked.others] == [("crate", "request"), ("vase", "embedded")]
    prior = asked.others[0].prior
    assert asked.others[0].role == "obstacle"
    assert prior is not None
    assert prior.size is not None
    assert (prior.shape, prior.size.value, prior.stands_on) == ("box", 0.3, "floor")


def test_a_mask_gives_box_and_outline_and_is_found_again(pixels: np.ndarray) -> None:
    run, mask = run_of(pixels, grounding={"bbox": MOVER}), circle((430, 260), 25)
    again = run_of(pixels, grounding={"bbox": MOVER}, objects=[{"object": "disc", "mask": kept(run, mask)}])
    result = ground(again)
    disc = result.value.others[0]
    assert disc.bbox == (405, 235, 456, 286)
    assert disc.mask is not None
    assert disc.mask.sha256 in result.artifacts
    assert (decode_own(again.backends.artifacts.read(disc.mask.sha256))[..., 0] == mask).all()
    seen = look_again(run, result.value)  # of a run that has found the grounding stored
    assert (seen.mask_in(disc.bbox).full() == (mask > 0)).all()


def test_the_mover_may_be_given_by_mask(pixels: np.ndarray) -> None:
    mask = circle((200, 200), 30)
    run = run_of(pixels, grounding={"mask": kept(run_of(pixels), mask), "object": "ball", "shape": "sphere"})
    mover = ground(run).value
    assert mover.bbox == (170, 170, 231, 231)
    assert mover.prior is not None
    assert mover.prior.shape == "sphere"
    assert (look_again(run, mover).mask_in(mover.bbox).full() == (mask > 0)).all()


@pytest.mark.parametrize(
    ("given", "pointer"),
    [
        ({"mask": np.zeros((400, 640), np.uint8)}, "/objects/1/mask"),
        ({"mask": np.full((400, 640), 255, np.uint8)}, "/objects/1/mask"),
        ({"mask": circle((100, 100), 30, (320, 200))}, "/objects/1/mask"),
        ({"bbox": (700, 10, 800, 90)}, "/objects/1/bbox"),
        ({"point": (10, 400)}, "/objects/1/point"),
        ({"point": (440, 260)}, "/objects/1"),
    ],
    ids=["an empty mask", "all of it", "another size", "a box outside", "a point outside", "again"],
)
def test_an_object_that_is_none_of_the_image_or_given_twice_is_refused(
    pixels: np.ndarray, given: dict, pointer: str
) -> None:
    given = {name: kept(run_of(pixels), value) if name == "mask" else value for name, value in given.items()}
    with refused("invalid-request", pointer):
        ground(
            run_of(
                pixels,
                grounding={"bbox": MOVER},
                objects=[{"object": "cube", "bbox": CUBE}, {"object": "disc", **given}],
            )
        )


def fur() -> np.ndarray:
    """A texture of many fine strokes, such as fur or grass."""
    rng, image = np.random.default_rng(0), np.full((400, 640, 3), (110, 90, 60), np.uint8)
    strokes = np.stack([rng.uniform(0, 640, 9000), rng.uniform(0, 400, 9000), rng.normal(0, 6, 9000)], axis=1)
    for (x, y, dx), shade in zip(strokes.tolist(), rng.normal(0, 30, 9000), strict=True):
        colour = np.clip(np.array((110, 90, 60)) + shade, 0, 255).tolist()
        cv2.line(image, (int(x), int(y)), (int(x + dx), int(y + 14)), colour, 1, cv2.LINE_AA)
    return image


@pytest.mark.slow
def test_a_tuft_of_fur_is_refused_unless_something_stands_out_there() -> None:
    image = fur()
    with refused("cannot-ground"):
        ground(run_of(image, grounding={"point": (320, 200)}))
    with refused("cannot-ground", "/objects/0/point"):
        ground(run_of(image, grounding={"bbox": MOVER}, objects=[{"object": "tuft", "point": (320, 200)}]))
    assert ground(run_of(image, trajectory={"points": [(320, 200), (400, 200)]})).warnings, (
        "a path says where it begins"
    )
    found = ground(run_of(ball(image, (320, 200), 45, (220, 40, 40)), grounding={"point": (320, 200)})).value
    assert found.bbox == pytest.approx((275, 155, 365, 245), abs=6)


def test_masks_are_kept_before_a_job_is_made_of_a_request(service: Service) -> None:
    data = base64.b64encode(png_bytes(np.repeat(circle((430, 260), 25)[..., None], 3, axis=2))).decode()
    objects = [{"object": "disc", "mask": f"data:image/png;base64,{data}"}]
    asked = SimulateRequest.model_validate({"image": "data:,", "question": "?", "objects": objects})
    asked = asked.model_copy(update={"image": ImageArtifact(artifact="0" * 64)})
    kept_request, files = service.digested(asked)
    service.keep(files)
    assert service.artifacts.read(kept_request.objects[0].mask.artifact)  # pyright: ignore[reportAttributeAccessIssue]
    assert service.digested(kept_request) == (kept_request, [])
    for mask in ("data:image/png;base64,AAAA", "data:,x"):
        wrong = asked.objects[0].model_copy(update={"mask": mask})
        with refused("invalid-request", "/objects/0/mask"):
            service.digested(asked.model_copy(update={"objects": (wrong,)}))


@pytest.mark.parametrize(
    ("asked", "question", "missing"),
    [
        ({"relation": "touches", "target": "blue mug"}, "?", ["blue mug"]),
        ({"relation": "touches", "subject": "lid", "target": "crate"}, "?", ["lid"]),
        ({"relation": "touches", "subject": "The Ball", "target": "a crate"}, "?", []),
        (None, "If the ball moves to the right, will it hit the blue mug?", ["blue mug"]),
        (None, "If the ball moves to the right, will it hit the crate?", []),
    ],
)
def test_what_is_asked_about_and_was_not_located_is_warned_of(
    pixels: np.ndarray, asked: dict | None, question: str, missing: list[str]
) -> None:
    given = {"question": question, "grounding": {"bbox": MOVER, "object": "ball"}}
    given |= {"objects": [{"object": "crate", "bbox": CUBE}]} | ({} if asked is None else {"asked": asked})
    warnings = ground(run_of(pixels, **given)).warnings
    assert len(warnings) == len(missing)
    assert all(f"'{name}'" in warning for name, warning in zip(missing, warnings, strict=True))
