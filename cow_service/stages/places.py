"""Places that a request gives: from a box, a point or a mask to the box and the mask of an object."""

from __future__ import annotations

from dataclasses import dataclass

from cow_service.errors import (
    ArtifactNotFound,
    CannotGround,
    FieldError,
    ImageTooLarge,
    ImageTypeUnsupported,
    ImageUnreadable,
    InvalidRequest,
    field_of,
)
from cow_service.media.artifacts import ArtifactStore
from cow_service.media.images import decode
from cow_service.records import BBox, Estimate, ObjectPrior, Point
from cow_service.requests import ImageArtifact, MaskRef, PlaceRequest
from cow_service.vision.masks import CroppedMask, bbox_of
from cow_service.vision.scene import Scene
from cow_service.vision.segmentation import cut_quality
from cow_service.vision.types import Mask

WHITE = 128  # grey level from which a pixel of a mask is the object's
MAX_MASK_SHARE = 0.95  # of the image: more is no object, but an image without a mask
# What is cut out around a point is taken for an object from here on. Objects of scenes with known truth have an area
# of 0.009 and more; of their good cuts one in twenty has less on edges, most tufts of fur or grass have.
LEAST_AREA = 0.0025  # of the square of the image's shorter side
LEAST_ON_EDGE = 0.75  # of the outline
LEAST_SOLIDITY = 0.5


@dataclass(frozen=True)
class Place:
    """Where an object is."""

    bbox: BBox  # px, inside the image
    has_mask: bool  # its outline does not follow from its box: the scene holds it, and it has to be stored
    warnings: tuple[str, ...] = ()


def place_of(
    scene: Scene, given: PlaceRequest, artifacts: ArtifactStore, pointer: str, *, may_guess: bool = False
) -> Place:
    """The place of an object; the scene knows its silhouette afterwards. `pointer` is the JSON Pointer to `given`.

    Raises `InvalidRequest` for a place outside the image and for a mask that is none of this image, and `CannotGround`
    where what can be cut out around a point is no object, unless `may_guess`.
    """
    if given.mask is not None:
        mask = _read_mask(scene, given.mask, artifacts, f"{pointer}/mask")
        bbox, cropped = bbox_of(mask), CroppedMask.of(mask)
        scene.preset_mask(bbox, cropped.full)
        return Place(bbox, has_mask=True)
    if given.point is not None:
        return _around(scene, given.point, pointer, may_guess=may_guess)
    x0, y0, x1, y1 = given.bbox or (0.0, 0.0, 0.0, 0.0)
    clipped = max(0.0, x0), max(0.0, y0), min(float(scene.width), x1), min(float(scene.height), y1)
    if clipped[2] - clipped[0] < 2 or clipped[3] - clipped[1] < 2:
        raise _outside(f"{pointer}/bbox", [x0, y0, x1, y1], scene)
    return Place(clipped, has_mask=False)


def prior_of(given: PlaceRequest) -> ObjectPrior | None:
    """What a request says of an object beside its place, taken as exact."""
    if given.shape is None and given.size is None and given.stands_on is None:
        return None
    size = None if given.size is None else Estimate(value=given.size, deviation=0.0)
    return ObjectPrior(shape=given.shape, size=size, stands_on=given.stands_on)


def _around(scene: Scene, point: Point, pointer: str, *, may_guess: bool) -> Place:
    """The object at a point, with a warning where its outline had to be guessed. Raises as `place_of` does."""
    x, y = point
    if not (0 <= x < scene.width and 0 <= y < scene.height):
        raise _outside(f"{pointer}/point", [x, y], scene)
    bbox = scene.bbox_at(point)
    if scene.region_of(bbox) is not None:
        return Place(bbox, has_mask=False)
    field = field_of(pointer)
    fault = None if may_guess else _fault_of_cut(scene, bbox)
    if fault is not None:
        detail = f"No object could be cut out around the point [{x:.0f}, {y:.0f}]: {fault}"
        raise CannotGround(
            f"{detail}. Give its box as `{field}.bbox`, or its outline as `{field}.mask`.",
            errors=(FieldError(f"{pointer}/point", detail),),
        )
    box = ", ".join(f"{value:.0f}" for value in bbox)
    warning = f"The object around the point was guessed to be [{box}]; `{field}.bbox` says it for certain."
    return Place(bbox, has_mask=True, warnings=(warning,))


def _fault_of_cut(scene: Scene, bbox: BBox) -> str | None:
    """Why what was cut out is no object, in words."""
    quality = cut_quality(scene.clean, scene.silhouette(bbox))
    if quality.area < LEAST_AREA:
        return f"what lies there is only {bbox[2] - bbox[0]:.0f} x {bbox[3] - bbox[1]:.0f} px large"
    if quality.on_edge < LEAST_ON_EDGE:
        return f"only {quality.on_edge:.0%} of the outline of what lies there can be seen"
    if quality.solidity < LEAST_SOLIDITY:
        return "what lies there is ragged, and looks like a part of something"
    return None


def _read_mask(scene: Scene, given: MaskRef, artifacts: ArtifactStore, pointer: str) -> Mask:
    """The mask [H, W] of the image that a request names. Raises `InvalidRequest`."""
    assert isinstance(given, ImageArtifact), "the masks of a request are kept before its stages run"
    try:
        picture = decode(artifacts.read(given.artifact), max_megapixels=scene.width * scene.height / 1e6)
    except (ArtifactNotFound, ImageTooLarge, ImageTypeUnsupported, ImageUnreadable) as error:
        raise mask_error(f"cannot be read: {error.detail}", pointer) from error
    width, height = picture.info.width, picture.info.height
    if (width, height) != (scene.width, scene.height):
        size = f"{scene.width} x {scene.height} px"
        raise mask_error(f"has {width} x {height} px where the upright image has {size}", pointer)
    mask = picture.pixels.min(axis=2) >= WHITE
    share = float(mask.mean())
    if not share:
        raise mask_error("is empty: no pixel is white", pointer)
    if share > MAX_MASK_SHARE:
        raise mask_error(f"covers {share:.0%} of the image: white, or transparent, is the object alone", pointer)
    return mask


def mask_error(fault: str, pointer: str) -> InvalidRequest:
    """What is wrong with the mask of a request."""
    field = field_of(pointer)
    return InvalidRequest(
        f"`{field}` {fault}. Give a PNG of the upright image's size, white where the object is and black elsewhere.",
        errors=(FieldError(pointer, fault),),
    )


def _outside(pointer: str, value: list[float], scene: Scene) -> InvalidRequest:
    detail = f"{value} lies outside the upright image of {scene.width} x {scene.height} px."
    return InvalidRequest(f"{detail} Give pixels, x right and y down.", errors=(FieldError(pointer, detail),))
