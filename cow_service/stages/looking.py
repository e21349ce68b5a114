"""A look at an image with the server's models, apart from any job: for callers who choose a thing by hand."""

import base64
from collections.abc import Sequence

from cow_service.errors import ArtifactNotFound, FieldError, InvalidRequest, PerceptionMissing, install_line
from cow_service.media.images import decode, encode_png
from cow_service.media.types import Image
from cow_service.perception.base import ImageKey, Perception, Thing
from cow_service.perception.observation import DOUBTFUL, Observation, SeenImages
from cow_service.perception.outlines import MOST_FOUND, Outline, outlines_at, outlines_in
from cow_service.records import BBox, Look, SeenObject
from cow_service.requests import LookRequest


def look(
    perception: Perception,
    seen: SeenImages,
    key: ImageKey,
    data: bytes | None,
    request: LookRequest,
    nouns: Sequence[str],
    most: float,
) -> Look:
    """What is at the point or in the box of a request, or is called by one of the nouns of its question.

    `data` is the image as it was sent, of `most` megapixels at the most; None: it is one that was looked at before.
    Without a segmenter things are those that are `seen` in the image. Raises `PerceptionUnavailable`, `InvalidRequest`
    for a place outside the image, `ArtifactNotFound`, and what `images.decode` raises.
    """

    def image() -> Image:
        kept = perception.source_of(key) if data is None else data
        if kept is None:
            raise ArtifactNotFound("The image is not in memory any more: send it again.")
        return decode(kept, max_megapixels=most).pixels

    needed = ("segmenter",) if request.question is None else ("segmenter", "detector")
    lacking = [kind for kind in needed if kind not in perception.names]
    if lacking and request.question is None and "finder" in perception.names:
        return found_at(seen.look(key, image), key, request)
    if lacking and request.question is None:
        raise PerceptionMissing("This server has no models that see: start it with COW_PERCEPTION=eye, or draw a box.")
    if lacking:
        raise PerceptionMissing(
            f"This server has no {' and no '.join(lacking)}: give the things' boxes instead, or start it with "
            f"COW_PERCEPTION=cpu, gpu, or names of models, which need {install_line('perception')}."
        )
    embedded = perception.embed(key, image, data)
    width, height = embedded.size
    things: list[SeenObject] = []
    if request.point is not None:
        _check_inside((*request.point, *request.point), embedded.size, "point")
        things = [_seen(each.bbox, each) for each in outlines_at(embedded, request.point)]
    elif request.bbox is not None:
        _check_inside(request.bbox, embedded.size, "bbox")
        things = [_seen(each.bbox, each) for each in outlines_in(embedded, [request.bbox]) if each is not None]
    elif nouns and (detector := perception.detector) is not None:
        found = detector.detect(image(), nouns)[:MOST_FOUND]
        outlines = outlines_in(embedded, [each.bbox for each in found])
        for each, outline in zip(found, outlines, strict=True):
            box = each.bbox if outline is None else outline.bbox
            things.append(_seen(box, outline).model_copy(update={"name": each.phrase, "score": each.score}))
    return Look(image=key[1], width=width, height=height, things=tuple(things))


def found_at(observation: Observation, key: ImageKey, request: LookRequest) -> Look:
    """What was found at the point or in the box of a request; of things within each other the smallest first."""
    size, found = (observation.width, observation.height), list[Thing]()
    if request.point is not None:
        _check_inside((*request.point, *request.point), size, "point")
        x, y = map(int, request.point)
        under = (thing for thing in observation.things if thing.mask.contains(x, y))
        found = sorted(under, key=lambda thing: thing.mask.area)
    elif request.bbox is not None:
        _check_inside(request.bbox, size, "bbox")
        thing = observation.thing_in(request.bbox)
        found = [] if thing is None else [thing]
    things = (
        _seen(each.bbox, Outline(observation.mask_in(each.bbox), each.confidence, each.confidence >= DOUBTFUL))
        for each in found
    )
    return Look(image=key[1], width=size[0], height=size[1], things=tuple(things))


def _seen(bbox: BBox, outline: Outline | None) -> SeenObject:
    mask = None
    if outline is not None and outline.is_sure:
        mask = f"data:image/png;base64,{base64.b64encode(encode_png(outline.mask.full())).decode()}"
    return SeenObject(bbox=bbox, mask=mask, score=0.0 if outline is None else outline.score)


def _check_inside(bbox: BBox, size: tuple[int, int], field: str) -> None:
    x0, y0, x1, y1 = bbox
    if not (0 <= x0 < size[0] and 0 <= y0 < size[1] and x0 <= x1 <= size[0] and y0 <= y1 <= size[1]):
        detail = f"lies outside the upright image of {size[0]} x {size[1]} px"
        raise InvalidRequest(
            f"`{field}` {detail}: give pixels of it, x right and y down.", errors=(FieldError(f"/{field}", detail),)
        )
