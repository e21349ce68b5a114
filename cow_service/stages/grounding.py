"""Stage 1: which object moves, and where it is."""

from __future__ import annotations

from cow_service.errors import FieldError, InvalidRequest
from cow_service.media.images import decode_own, encode_png
from cow_service.readers.base import GroundingReading
from cow_service.records import BBox, Grounding, Point, Source
from cow_service.requests import GroundingRequest, SimulateRequest
from cow_service.stages.results import StageResult
from cow_service.stages.run import Run
from cow_service.vision.scene import Scene

DEFAULT_NAME = "object"


def ground(run: Run[SimulateRequest]) -> StageResult[Grounding]:
    """The mover, from the request where it says so, else from the reader; its mask [H, W] is stored as PNG.

    Raises `InvalidRequest` for a place outside the image, and what the reader raises.
    """
    place = run.request.place
    source: Source = "request"
    if place is None:
        reading, source = run.reader.ground(run.reader_input("grounding")), run.reader.source
    else:
        with run.cpu():
            reading = _given(run.scene, place)
    with run.cpu():
        mask = run.backends.artifacts.put(encode_png(run.scene.silhouette(reading.bbox)), "image/png")
    grounding = Grounding(
        object=reading.object,
        point=reading.point or _centre(reading.bbox),
        bbox=reading.bbox,
        mask=mask,
        others=reading.others,
        source=source,
    )
    return StageResult(value=grounding, warnings=reading.warnings, artifacts=(mask.sha256,), hints=reading.hints)


def use_stored_mask(run: Run[SimulateRequest], grounding: Grounding) -> None:
    """Has the scene use the stored mask of a grounding that was found again.

    A mask cut again from its box may differ from one that was cut around a point.
    """
    mask = grounding.mask
    if mask is not None:
        read = run.backends.artifacts.read
        run.scene.preset_mask(grounding.bbox, lambda: decode_own(read(mask.sha256))[..., 0] > 0)


def _given(scene: Scene, place: GroundingRequest) -> GroundingReading:
    """What a request says of the object, and a warning where its outline had to be guessed around a point."""
    bbox = _bbox_of(scene, place)
    warnings: tuple[str, ...] = ()
    if place.point is not None and scene.region_of(bbox) is None:
        box = ", ".join(f"{value:.0f}" for value in bbox)
        warnings = (f"The object around the point was guessed to be [{box}]; `grounding.bbox` says it for certain.",)
    return GroundingReading(place.object or DEFAULT_NAME, bbox, warnings=warnings)


def _bbox_of(scene: Scene, place: GroundingRequest) -> BBox:
    if place.point is not None:
        x, y = place.point
        if not (0 <= x < scene.width and 0 <= y < scene.height):
            raise _outside("/grounding/point", list(place.point), scene)
        return scene.bbox_at(place.point)
    x0, y0, x1, y1 = place.bbox or (0.0, 0.0, 0.0, 0.0)
    clipped = max(0.0, x0), max(0.0, y0), min(float(scene.width), x1), min(float(scene.height), y1)
    if clipped[2] - clipped[0] < 2 or clipped[3] - clipped[1] < 2:
        raise _outside("/grounding/bbox", [x0, y0, x1, y1], scene)
    return clipped


def _outside(pointer: str, value: list[float], scene: Scene) -> InvalidRequest:
    detail = f"{value} lies outside the upright image of {scene.width} x {scene.height} px."
    return InvalidRequest(f"{detail} Give pixels, x right and y down.", errors=(FieldError(pointer, detail),))


def _centre(bbox: BBox) -> Point:
    return (bbox[0] + bbox[2]) / 2, (bbox[1] + bbox[3]) / 2
