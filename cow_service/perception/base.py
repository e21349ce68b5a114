"""The Protocols of vision models, and the choice of a server. Stages know this file, never an implementation.

Images are RGB [H, W, 3], uint8; boxes and points are pixels of them.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from threading import RLock
from typing import Any, Literal, Protocol, cast

import cv2

from cow_service.errors import PerceptionMissing, PerceptionUnavailable
from cow_service.media.masks import CroppedMask
from cow_service.media.types import Floats, Floats32, Image, Mask
from cow_service.records import BBox, Point
from cow_service.registry import Registry
from cow_service.settings import Settings, SettingsError
from cow_service.weights.manifests import check_modules

PerceptionKind = Literal["finder", "segmenter", "detector", "depth", "inpainter"]
GROUPS: dict[PerceptionKind, str] = {
    "finder": "cow_service.finders",
    "segmenter": "cow_service.segmenters",
    "detector": "cow_service.detectors",
    "depth": "cow_service.depth_estimators",
    "inpainter": "cow_service.inpainters",
}
SETS: dict[str, tuple[str, ...]] = {  # by the value of COW_PERCEPTION; all of them under permissive licences
    "none": (),
    "cpu": ("sam2-tiny", "grounding-dino-tiny", "moge-2-small"),
    "gpu": ("sam2-large", "grounding-dino-base", "moge-2-large"),
}
ImageKey = tuple[str | None, str]
"""The owner of the image, so that timing does not reveal the images of others; and its SHA-256."""
EYE = "eye"  # the finder of the default installation
MOST_EMBEDDINGS = 8  # images whose embedding is kept: some 16 MB each of a large model


@dataclass(frozen=True)
class Thing:
    """One object of the image: its place and its colour. Not what kind of object it is, nor whether it moves."""

    mask: CroppedMask
    colour: str
    colours: frozenset[str]  # all names that people may use for its colour
    roundness: float  # 0..1, of the smallest circle around it: a disc has 1, a square 0.8, a bottle less than 0.5
    confidence: float  # 0..1: how sure it is that this is one separable thing with this outline
    is_disc: bool  # its outline was fitted by a circle: the mask is exact, segmenting it again would not improve it
    is_hidden: bool = False  # by another thing in front of it, in part: its outline tells little
    called: frozenset[str] = frozenset()  # the names under which a model found it

    @property
    def bbox(self) -> BBox:
        """Tight box [x0, y0, x1, y1], px of the image."""
        return self.mask.bbox

    @property
    def centre(self) -> tuple[float, float]:
        """Centre of the box, px."""
        return (self.bbox[0] + self.bbox[2]) / 2, (self.bbox[1] + self.bbox[3]) / 2


class Finder(Protocol):
    """Finds what stands in a picture. Safe to use from several threads, as all of these are."""

    fingerprint: str
    """Everything that determines what it finds: model, revision, options. The same holds for all protocols here."""

    def find(self, image: Image, names: Sequence[str] = ()) -> tuple[Thing, ...]:
        """Things in an image without drawings on it: those of some names, or whatever stands there if it knows none."""
        ...


Find = Callable[[Image], tuple[Thing, ...]]
"""Finds whatever stands in an image without drawings on it."""


@dataclass(frozen=True)
class Prompt:
    """Where a thing is: a point on it, or a box around it."""

    point: Point | None = None
    bbox: BBox | None = None


@dataclass(frozen=True)
class Segment:
    """A mask that a segmenter proposes."""

    logits: Floats32  # [h, w] over the whole image, at the model's own size; above 0 where the thing is
    score: float  # 0..1: how good the model takes it to be

    @property
    def mask(self) -> Mask:
        """[h, w] at the model's own size."""
        return self.logits > 0

    def enlarged(self, width: int, height: int) -> CroppedMask:
        """The mask of the image. Logits are enlarged, not the mask: its edges would be stairs."""
        return CroppedMask.of(cv2.resize(self.logits, (width, height), interpolation=cv2.INTER_LINEAR) > 0)


class Segmenter(Protocol):
    """Cuts things out."""

    fingerprint: str

    def embed(self, image: Image) -> Any:
        """What it knows of an image before it is asked for a thing: computed once, used for every prompt."""
        ...

    def segment(self, embedding: Any, prompts: Sequence[Prompt]) -> tuple[tuple[Segment, ...], ...]:
        """For each prompt some candidates, the best first: a point may mean a part or the whole."""
        ...


@dataclass(frozen=True)
class Detection:
    """A thing that a detector found for a phrase."""

    phrase: str  # one of those that were asked for
    bbox: BBox
    score: float  # 0..1


class Detector(Protocol):
    """Finds things by their names."""

    fingerprint: str

    def detect(self, image: Image, phrases: Sequence[str]) -> tuple[Detection, ...]:
        """The things that the phrases name, best first; a phrase may have none or several."""
        ...


@dataclass(frozen=True)
class DepthReading:
    """How far away what an image shows is."""

    depth: Floats  # [h, w] over the whole image, along the optical axis; nan where nothing is known
    scale: float | None  # metres per unit; None: relative, proportional to distances
    focal: float | None  # px of the image; None if the model does not tell
    deviation: float  # relative, one standard deviation


class DepthEstimator(Protocol):
    """Estimates depth, and maybe the focal length."""

    fingerprint: str

    def estimate(self, image: Image, focal: float | None) -> DepthReading:
        """`focal` (px) is that of the image's EXIF, where it has one."""
        ...


class Inpainter(Protocol):
    """Paints the background behind what is taken out."""

    fingerprint: str

    def fill(self, image: Image, hole: Mask, progress: Callable[[float], None]) -> Image:
        """The image with other pixels inside the hole [H, W], and the same outside.

        `progress` hears 0 to 1, and may raise `Canceled`.
        """
        ...


@dataclass(frozen=True)
class Embedded:
    """An image that a segmenter has looked at."""

    segmenter: Segmenter
    embedding: Any
    size: tuple[int, int]  # width and height, px
    source: bytes | None  # the image as it was sent, where a look may need its pixels again

    def segment(self, prompts: Sequence[Prompt]) -> tuple[tuple[Segment, ...], ...]:
        """Candidates for each prompt."""
        return self.segmenter.segment(self.embedding, prompts) if prompts else ()


class Perception:
    """The models that a server sees with, loaded when they are first needed. Safe to use from several threads."""

    def __init__(self, settings: Settings) -> None:
        """Raises `SettingsError` for unknown names, and for two of one kind."""
        self._registries: dict[PerceptionKind, Registry[Any]] = {
            kind: Registry(group, PerceptionUnavailable, settings) for kind, group in GROUPS.items()
        }
        self.names: dict[PerceptionKind, str] = self._chosen(settings.perception)
        self._embeddings: OrderedDict[ImageKey, Embedded] = OrderedDict()
        self._lock = RLock()  # `embed` asks for an image with it held, which may be one that is kept here

    def _chosen(self, wanted: str) -> dict[PerceptionKind, str]:
        said = [each.strip().lower() for each in wanted.split(",") if each.strip()]
        if "none" in said and len(said) > 1:
            raise SettingsError("Bad settings: COW_PERCEPTION: 'none' turns all models off: name it alone.")
        if said in (["none"], [EYE]):  # without a look at what is installed, which takes 35 ms
            return {} if said == ["none"] else {"finder": EYE}
        chosen: dict[PerceptionKind, str] = {}
        kinds: dict[str, PerceptionKind] = {name: kind for kind, name in self.installed()}
        for name in (name for each in said for name in SETS.get(each, (each,))):
            kind = kinds.get(name)
            if kind is None or kind in chosen:
                known = ", ".join((*SETS, *kinds))
                fault = "is no such model" if kind is None else f"is a second {kind} beside {chosen[kind]!r}"
                raise SettingsError(f"Bad settings: COW_PERCEPTION: {name!r} {fault}. It takes: {known}.")
            chosen[kind] = name
        return {"finder": EYE, **chosen}

    def installed(self) -> list[tuple[PerceptionKind, str]]:
        """All that may be chosen, by kind and name."""
        return [(kind, name) for kind, registry in self._registries.items() for name in registry.names()]

    def load(self, kind: PerceptionKind) -> Any | None:
        """The model of a kind, None if the server has none. Raises `PerceptionUnavailable`."""
        if kind not in self.names:
            return None
        check_modules(self.names[kind], PerceptionMissing)
        return self._registries[kind].get(self.names[kind])

    @property
    def finder(self) -> Finder | None:
        """See `segmenter`."""
        return cast(Finder | None, self.load("finder"))

    @property
    def segmenter(self) -> Segmenter | None:
        """None if the server has none; so of the others. Raises `PerceptionUnavailable`."""
        return cast(Segmenter | None, self.load("segmenter"))

    @property
    def detector(self) -> Detector | None:
        """See `segmenter`."""
        return cast(Detector | None, self.load("detector"))

    @property
    def depth(self) -> DepthEstimator | None:
        """See `segmenter`."""
        return cast(DepthEstimator | None, self.load("depth"))

    @property
    def inpainter(self) -> Inpainter | None:
        """See `segmenter`."""
        return cast(Inpainter | None, self.load("inpainter"))

    def identity(self, kinds: Sequence[PerceptionKind]) -> dict[str, str]:
        """What decides the work of the models of some kinds, as far as the server has them."""
        return {kind: model.fingerprint for kind in kinds if (model := self.load(kind)) is not None}

    def source_of(self, key: ImageKey) -> bytes | None:
        """The bytes of an image that was looked at, as long as they are kept."""
        with self._lock:
            found = self._embeddings.get(key)
            return None if found is None else found.source

    def embed(self, key: ImageKey, image: Callable[[], Image], source: bytes | None = None) -> Embedded:
        """What the segmenter knows of an image, which is asked for only where it is new. There must be a segmenter."""
        segmenter = self.segmenter
        assert segmenter is not None, "called only if there is a segmenter"
        with self._lock:  # also during a look: callers with the same image wait, and the model takes one at a time
            found = self._embeddings.get(key)
            if found is None:
                pixels = image()
                found = Embedded(segmenter, segmenter.embed(pixels), (pixels.shape[1], pixels.shape[0]), source)
                self._embeddings[key] = found
            elif found.source is None and source is not None:
                self._embeddings[key] = found = replace(found, source=source)
            self._embeddings.move_to_end(key)
            while len(self._embeddings) > MOST_EMBEDDINGS:
                self._embeddings.popitem(last=False)
        return found

    def close(self) -> None:
        """Lets go of the models."""
        for registry in self._registries.values():
            registry.close()
        with self._lock:
            self._embeddings.clear()
