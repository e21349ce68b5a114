"""Images as a multimodal LLM sees them, how families of models write places, and the pixels that they mean.

The convention comes from the family's file in `models/families/`; nothing is inferred from the size of the numbers.
Everything becomes pixels before any geometry: a direction read off numbers in thousandths of width and height is
skewed by the aspect ratio of the image.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from cow_service.errors import InvalidRequest
from cow_service.media.images import encode_jpeg
from cow_service.readers.mllm.replies import ReplyError, Schema, fields_of, is_number, listed
from cow_service.records import BBox, Coordinates, Point
from cow_service.weights.manifests import Family, ImageSize

MEDIA_TYPE = "image/jpeg"
QUALITY = 95  # percent; fine lines such as drawn arrows stay clean
OVERSHOOT = 0.02  # of the image's side: so far outside a place is cut off at the edge, further out it is refused
LEAST_SIDE = 2.0  # px of the upright image: a narrower box has no area
LEAST_LENGTH = 2.0  # px of the upright image between the ends of a direction
MAX_RATIO = 200  # of the sides: what rounds sides to multiples takes no narrower image
NUMBER = r"[-+]?(?:\d{1,12}(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d{1,2})?"
_GAP = r"[\s\[\](){},;]"
_NUMBERS = re.compile(rf"{_GAP}*{NUMBER}(?:{_GAP}+{NUMBER})*{_GAP}*")
MAX_BOX_SHARE = 0.9  # of the image: a box that covers so much is hardly that of one object
HUGE = 1e9  # no coordinate is that large
_NAMED = (  # objects instead of lists; the names decide then, not the family's order
    ("x0", "y0", "x1", "y1"),
    ("x1", "y1", "x2", "y2"),
    ("xmin", "ymin", "xmax", "ymax"),
    ("x_min", "y_min", "x_max", "y_max"),
    ("left", "top", "right", "bottom"),
)
_SIZED = (("x", "y", "width", "height"), ("x", "y", "w", "h"), ("left", "top", "width", "height"))
_CORNERS = (("top_left", "bottom_right"), ("start", "end"), ("from", "to"), ("tail", "tip"), ("tail", "head"))


def size_seen(width: int, height: int, rule: ImageSize) -> tuple[int, int]:
    """Width and height (px) at which a model sees an image: sent at that size, it is not resized again.

    Sides are rounded to multiples, then both are scaled until the area fits (transformers, `smart_resize` of Qwen2-VL).
    Raises `ReplyError` for an image so narrow that no such size exists.
    """
    multiple = rule.multiple
    if multiple > 1 and max(width, height) > MAX_RATIO * min(width, height):
        raise ReplyError(f"the model takes no image of {width} x {height} px: its sides differ more than 200-fold")
    longest = max(width, height)
    if rule.max_side is not None and longest > rule.max_side:
        width, height = (max(1, round(side * rule.max_side / longest)) for side in (width, height))
    wide, high = (round(side / multiple) * multiple for side in (width, height))
    if wide * high > rule.max_pixels:
        shrink = math.sqrt(width * height / rule.max_pixels)
        wide, high = (max(multiple, math.floor(side / shrink / multiple) * multiple) for side in (width, height))
    elif wide * high < rule.min_pixels:
        grow = math.sqrt(rule.min_pixels / (width * height))
        wide, high = (math.ceil(side * grow / multiple) * multiple for side in (width, height))
    return max(multiple, wide), max(multiple, high)


@dataclass(frozen=True)
class CoordinateFrame:
    """An upright image of `width` x `height` px as a model sees it: at `seen` px, in its family's coordinates."""

    width: int
    height: int
    seen: tuple[int, int]
    coordinates: Coordinates

    @property
    def _full(self) -> tuple[float, float]:
        """What the family writes for the right and the lower edge."""
        return {"pixels": self.seen, "thousandths": (1000.0, 1000.0), "fractions": (1.0, 1.0)}[self.coordinates.units]

    @property
    def units(self) -> str:
        """What the numbers count, in words for a prompt."""
        width, height = self.seen
        return {
            "thousandths": "thousandths of the image's width and height, 0 to 1000",
            "fractions": "fractions of the image's width and height, 0 to 1, with three decimals",
            "pixels": f"pixels of the image, which is {width} wide and {height} high, from its top left corner",
        }[self.coordinates.units]

    @property
    def box_order(self) -> str:
        """The order of a box's numbers, in words for a prompt."""
        if self.coordinates.box_form == "size":
            return "[x, y, width, height]" if self.coordinates.axes == "xy" else "[y, x, height, width]"
        return "[x0, y0, x1, y1]" if self.coordinates.axes == "xy" else "[ymin, xmin, ymax, xmax]"

    @property
    def point_order(self) -> str:
        """The order of a point's numbers, in words for a prompt."""
        return "[x, y]" if self.coordinates.axes == "xy" else "[y, x]"

    def schema(self, count: int) -> Schema:
        """The JSON schema of so many coordinates."""
        number = {"type": "number" if self.coordinates.units == "fractions" else "integer"}
        return {"type": "array", "items": number, "minItems": count, "maxItems": count}

    def point(self, written: object) -> Point:
        """A point in pixels. Raises `ReplyError` if two numbers inside the image are not what was written."""
        return self._inside(*self._pairs(written, 1, "a point is 2 numbers")[0])

    def bbox(self, written: object) -> BBox:
        """A box [x0, y0, x1, y1] in pixels, its corners sorted. Raises `ReplyError` for one outside or without area."""
        corner, (right, lower) = self._pairs(written, 2, "a box is 4 numbers")
        if self.coordinates.box_form == "size" and not fields_of(written):  # names say which numbers they are
            right, lower = corner[0] + right, corner[1] + lower
        (ax, ay), (bx, by) = self._inside(*corner), self._inside(right, lower)
        x0, y0, x1, y1 = min(ax, bx), min(ay, by), max(ax, bx), max(ay, by)
        if x1 - x0 < LEAST_SIDE or y1 - y0 < LEAST_SIDE:
            raise ReplyError(f"the box {_shown(written)} has no area; give {self.box_order} of the object")
        return x0, y0, x1, y1

    def ends(self, written: object) -> tuple[Point, Point]:
        """Where a line begins and ends, in pixels. Raises `ReplyError` for one outside or without length."""
        start, end = (self._inside(*pair) for pair in self._pairs(written, 2, "a line is two points"))
        if math.dist(start, end) < LEAST_LENGTH:
            raise ReplyError(f"the direction {_shown(written)} has no length; give two different points")
        return start, end

    def write_box(self, bbox: BBox) -> list[float]:
        """A box in pixels as the family writes it."""
        x0, y0, x1, y1 = bbox
        return self.write((x0, y0), (x1 - x0, y1 - y0) if self.coordinates.box_form == "size" else (x1, y1))

    def write(self, *points: Point) -> list[float]:
        """Points as the family writes them, one after the other."""
        numbers: list[float] = []
        for x, y in points:
            pair = x / self.width * self._full[0], y / self.height * self._full[1]
            digits = 3 if self.coordinates.units == "fractions" else None
            rounded = [round(value, digits) for value in pair]
            numbers += rounded if self.coordinates.axes == "xy" else rounded[::-1]
        return numbers

    def _inside(self, x: float, y: float) -> Point:
        """The pixel that is meant; what lies over the edge by a hair is moved onto it."""
        for value, limit in ((x, self._full[0]), (y, self._full[1])):
            if not -OVERSHOOT * limit <= value <= (1 + OVERSHOOT) * limit:
                raise ReplyError(f"{value:g} lies outside the image: coordinates go from 0 to {limit:g}")
        width, height = self._full
        return min(max(x, 0.0), width) / width * self.width, min(max(y, 0.0), height) / height * self.height

    def _pairs(self, written: object, count: int, wanted: str) -> list[tuple[float, float]]:
        """Pairs (x, y) in the family's units, also from points in a list or by name. Raises `ReplyError`."""
        fields = fields_of(written)
        ends = next(([fields[a], fields[b]] for a, b in _CORNERS if a in fields and b in fields), written)
        if count == 2 and len(listed(ends)) == 2:
            return [pair for end in listed(ends) for pair in self._pairs(end, 1, wanted)]
        named = _by_name(fields, count)
        numbers = named or _numbers(written)
        if len(numbers) != 2 * count:
            raise ReplyError(f"{wanted}, not {_shown(written)}")
        pairs = list(zip(numbers[::2], numbers[1::2], strict=True))
        return pairs if named or self.coordinates.axes == "xy" else [(x, y) for y, x in pairs]


@dataclass(frozen=True)
class EncodedImage:
    """An image ready to send, as JPEG, and its size as the model sees it."""

    jpeg: bytes
    coordinate_frame: CoordinateFrame


def encode(pixels: NDArray[np.uint8], family: Family) -> EncodedImage:
    """RGB [h, w, 3] for a family of models. Raises `InvalidRequest` for a shape that it takes at no size."""
    height, width = pixels.shape[:2]
    try:
        size = size_seen(width, height, family.image)
    except ReplyError as error:
        raise InvalidRequest(f"The image cannot be shown to the multimodal LLM: {error}.") from error
    if size != (width, height):
        smaller = size[0] * size[1] < width * height
        resized = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_CUBIC)
        pixels = np.asarray(resized, np.uint8)
    return EncodedImage(encode_jpeg(pixels, QUALITY), CoordinateFrame(width, height, size, family.coordinates))


def _numbers(written: object) -> list[float]:
    """The finite numbers that were written, lists inside lists unfolded; none where anything else is among them."""
    if isinstance(written, str):
        return [float(found) for found in re.findall(NUMBER, written)] if _NUMBERS.fullmatch(written) else []
    if is_number(written):
        return [float(written)] if abs(written) < HUGE else []  # NaN is not less than anything
    parts = [_numbers(part) for part in cast("Sequence[object]", written)] if isinstance(written, list | tuple) else []
    return [number for part in parts for number in part] if all(parts) else []


def _by_name(fields: Mapping[str, Any], count: int) -> list[float]:
    """The numbers of an object such as {"x0": ..., "y0": ...}, x first; none where its fields have other names."""
    for x, y, width, height in _SIZED if count == 2 else ():
        if {x, y, width, height} <= fields.keys():
            left, top, wide, high = ((_numbers(fields[name]) or [math.nan])[0] for name in (x, y, width, height))
            return [left, top, left + wide, top + high]
    known = _NAMED if count == 2 else (("x", "y"),)
    names = next((names for names in known if fields.keys() >= set(names)), ())
    return [number for name in names for number in _numbers(fields[name])]


def covers_image(width: int, height: int, bbox: BBox) -> bool:
    """Whether a box covers nearly the whole image of `width` x `height` px."""
    x0, y0, x1, y1 = bbox
    return (x1 - x0) * (y1 - y0) > MAX_BOX_SHARE * width * height


def names_corners(fields: Mapping[str, Any]) -> bool:
    """Whether an object is itself a box, its corners or edges by name."""
    return any(set(names) <= set(fields) for names in (*_NAMED, *_SIZED, _CORNERS[0]))


def _shown(written: object) -> str:
    return repr(written)[:80]
