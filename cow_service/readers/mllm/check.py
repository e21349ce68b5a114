"""A check of a multimodal LLM: five small questions about pictures that ship with COW, whose answers are known."""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal, TypeVar, cast

from cow_service.errors import CowError, MllmUnavailable
from cow_service.media.images import decode
from cow_service.media.masks import iou
from cow_service.narration.words import same_name
from cow_service.perception.observation import look
from cow_service.readers.base import CallLog, ReaderInput, ReadResult
from cow_service.readers.mllm.answer import answer_calls
from cow_service.readers.mllm.client import PARSER_BUGS, MllmClient, PromptCall
from cow_service.readers.mllm.contents import QUESTIONS
from cow_service.readers.mllm.coordinates import CoordinateFrame, encode
from cow_service.readers.mllm.identify import identify_call
from cow_service.readers.mllm.known import USUAL
from cow_service.readers.mllm.locate import locate_call, read_located
from cow_service.readers.mllm.replies import ReplyError
from cow_service.records import AnswerOption, BBox, Coordinates, MllmMeasurement, MotionRequest, Record, Usage, Vector
from cow_service.weights.manifests import EXAMPLES

FOUND = 0.5  # intersection over union from which a box counts as that of the thing
ASIDE = 45.0  # degrees from which a direction counts as another one
FORMS = tuple(product(("thousandths", "fractions", "pixels"), ("xy", "yx"), ("corners", "size")))  # of coordinates
WHICH = "These are four pictures of different scenes. Which of them shows a red bottle?"
PLACES = ("the first", "the second", "the third", "the fourth")  # of the pictures in `QUESTIONS`

T = TypeVar("T")


@dataclass(frozen=True)
class Truth:
    """What is true of an example picture: boxes (px), and which way the mover goes in it (a unit vector)."""

    boxes: dict[str, BBox]  # the mover's first
    way: Vector
    along_arrow: bool


TRUTHS = {
    "ball-and-mug": Truth(
        {"yellow ball": (245.3, 194.3, 305.9, 254.0), "blue mug": (440.7, 216.1, 521.2, 297.9)}, (0.983, 0.182), False
    ),
    "bottle-passes-cylinder": Truth(
        {"red bottle": (125.0, 190.7, 201.3, 375.2), "white cylinder": (386.0, 141.7, 456.0, 264.9)}, (1.0, 0.0), True
    ),
    "thrown-ball": Truth(
        {"pink ball": (198.5, 24.5, 268.5, 94.5), "white cube": (494.9, 203.1, 589.2, 292.2)}, (0.881, -0.474), True
    ),
}


class Finding(Record):
    """How one of the questions went."""

    question: Literal["box", "direction", "sense", "JSON", "images"]
    usable: bool
    result: str


class MllmCheck(Record):
    """What a check has found. `measured` is null where most boxes were not found, or no direction was given."""

    findings: tuple[Finding, ...]
    measured: MllmMeasurement | None
    usage: Usage
    seconds: float  # of the longest question, with its repeats


@dataclass(frozen=True)
class WrittenPlaces:
    """What was written about one picture; nothing where the call failed."""

    truth: Truth
    frame: CoordinateFrame
    text: str

    def read(self, coordinates: Coordinates) -> ReadResult:
        """What it says if places are written in that way; nothing where it cannot be read."""
        frame, (mover, *others) = replace(self.frame, coordinates=coordinates), self.truth.boxes
        try:
            located = read_located(self.text, frame, mover, others, wants_box=True, wants_direction=True)
        except ReplyError as error:
            located = cast("ReadResult | None", error.usable)
        except PARSER_BUGS:
            located = None
        return located or ReadResult()

    def pairs(self, coordinates: Coordinates) -> list[tuple[BBox, BBox]]:
        """The true box and the one that was written, of each thing that was found."""
        read, (mover, target) = self.read(coordinates).reading, self.truth.boxes
        named = (each.bbox for each in read.objects if same_name(each.object, target))
        written = {mover: read.grounding and read.grounding.bbox, target: next(named, None)}
        return [(self.truth.boxes[name], box) for name, box in written.items() if box is not None]


def check_model(client: MllmClient, reasoning_length: int) -> MllmCheck:
    """Asks for boxes, directions and senses in three pictures, for a JSON object, and about four pictures at once.

    What the server takes is found out anew. A reply that cannot be used, and a refusal, become findings. Raises
    `MllmUnavailable`.
    """
    client.capabilities.forget()
    log, seconds, family = CallLog(), list[float](), client.family
    pictures = {name: decode(EXAMPLES[name].file("image").read_bytes()).pixels for name in QUESTIONS}
    images = {name: encode(pixels, family) for name, pixels in pictures.items()}
    inputs = {name: ReaderInput(pixels, QUESTIONS[name], look(pixels), calls=log) for name, pixels in pictures.items()}

    def ask(name: str, call: PromptCall[T]) -> T | CowError:
        began = time.monotonic()
        (result,) = client.complete_all([call], inputs[name])
        seconds.append(time.monotonic() - began)
        if isinstance(result, MllmUnavailable):
            raise result
        return result

    written, failed = list[WrittenPlaces](), None
    for name, truth in TRUTHS.items():
        mover, *others = truth.boxes
        call = locate_call(inputs[name], images[name], mover, None, others, True, reasoning_length)
        text = ask(name, cast("PromptCall[str]", replace(call, parse=str)))  # whatever it says
        failed = text if isinstance(text, CowError) else failed
        written.append(WrittenPlaces(truth, images[name].coordinate_frame, "" if text is failed else cast("str", text)))
    findings, measured = _of_places(written, client.model.family.coordinates, family.coordinates, failed)

    name = "ball-and-mug"
    identified = ask(name, identify_call(inputs[name], images[name], reasoning_length))
    named = getattr(identified, "object", "nothing")
    told = f"read; what moves is '{named}', it says"
    findings.append(_finding("JSON", identified, same_name(named, next(iter(TRUTHS[name].boxes))), told))
    options = [AnswerOption(letter=letter, text=text) for letter, text in zip("ABCD", PLACES, strict=True)]
    jpegs = tuple(image.jpeg for image in images.values())
    chosen = ask(name, answer_calls(WHICH, options, jpegs, None, 1, reasoning_length)[0])
    is_right = getattr(chosen, "answer", None) == options[list(QUESTIONS).index("bottle-passes-cylinder")].letter
    told = f"{len(jpegs)} pictures at once, {'told apart' if is_right else 'not told apart'}"
    findings.append(_finding("images", chosen, is_right, told))
    return MllmCheck(findings=tuple(findings), measured=measured, usage=log.usage, seconds=max(seconds))


def _finding(question: Literal["JSON", "images"], said: object, usable: bool, result: str) -> Finding:
    failed = f"{said.code}: {said}" if isinstance(said, CowError) else ""
    return Finding(question=question, usable=usable and not failed, result=failed or result)


def _of_places(
    written: Sequence[WrittenPlaces], usual: Coordinates, used: Coordinates, failed: CowError | None
) -> tuple[list[Finding], MllmMeasurement | None]:
    """The findings on boxes, directions and senses, and what they come to.

    `usual` are the coordinates of the family, and `used` those that were asked for; others are taken where most boxes
    are found in them. `failed` is what a call came to.
    """

    def pairs(coordinates: Coordinates) -> list[tuple[BBox, BBox]]:
        return [pair for reply in written for pair in reply.pairs(coordinates)]

    others = [used.model_copy(update=dict(zip(("units", "axes", "box_form"), form, strict=True))) for form in FORMS]
    count = sum(len(reply.truth.boxes) for reply in written)
    best = max((used, *others), key=lambda coordinates: sum(iou(*pair) for pair in pairs(coordinates)))
    found = _count_found(pairs(best))
    if not (is_found := found * 2 > count):
        best, found = used, _count_found(pairs(used))
    boxes = finding_of_boxes(found, count, best, used, failed)
    lines = [(reply.truth, reply.read(best).reading.motion or MotionRequest()) for reply in written]
    off = [_degrees(truth.way, line.direction) for truth, line in lines if line.direction is not None]
    findings = [boxes, *findings_of_lines(lines, off)]
    if not is_found or not off:
        return findings, None
    edges = [_edges_off(*pair) for pair in pairs(best)]
    return findings, MllmMeasurement(
        coordinates=None if best == usual else best,
        bbox_deviation=min(1.0, _spread(USUAL.bbox_deviation, edges)),
        direction_deviation=min(90.0, _spread(USUAL.direction_deviation, off)),
    )


def finding_of_boxes(found: int, count: int, best: Coordinates, used: Coordinates, failed: CowError | None) -> Finding:
    """The finding on boxes: so many were found, of how many, and in which coordinates."""
    result = f"{found} of {count} found"
    if best != used:
        result += f", read as {best.words}; asked for were {used.words}"
    if failed is not None:
        result += f"; {failed.code}: {failed}"
    return Finding(question="box", usable=found == count and best == used, result=result)


def _count_found(pairs: Sequence[tuple[BBox, BBox]]) -> int:
    return sum(iou(*pair) >= FOUND for pair in pairs)


def findings_of_lines(lines: Sequence[tuple[Truth, MotionRequest]], off: Sequence[float]) -> Iterator[Finding]:
    """The findings on directions, so many degrees `off`, and on their senses."""
    result = f"{len(off)} of {len(lines)} given"
    if off:
        result += f", {', '.join(f'{each:.0f}' for each in off)} degrees off"
    yield Finding(question="direction", usable=len(off) == len(lines) and max(off) < ASIDE, result=result)
    senses = sum(line.along_arrow == truth.along_arrow for truth, line in lines)
    result = f"{senses} of {len(lines)} right, along or against an arrow"
    yield Finding(question="sense", usable=senses == len(lines), result=result)


def _spread(usual: float, off: Sequence[float]) -> float:
    """One standard deviation. The usual one counts as one measurement: a few pictures show no model to be exact."""
    return math.sqrt((usual**2 + sum(each**2 for each in off)) / (1 + len(off)))


def _edges_off(true: BBox, box: BBox) -> float:
    """Root mean square of how far the edges of a box are off, in its sides."""
    sides = (true[2] - true[0], true[3] - true[1]) * 2
    return math.sqrt(sum(((a - b) / side) ** 2 for a, b, side in zip(true, box, sides, strict=True)) / 4)


def _degrees(true: Vector, way: Vector) -> float:
    """Between two directions."""
    off = math.degrees(math.atan2(way[1], way[0]) - math.atan2(true[1], true[0]))
    return abs((off + 180) % 360 - 180)
