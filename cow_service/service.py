"""The composition root: settings in, a service that simulates out. Nothing else chooses a backend."""

from __future__ import annotations

import base64
import binascii
import re
from collections.abc import Generator as Steps
from contextlib import contextmanager
from functools import partial
from threading import Lock

from cow_service.concurrency import Turns
from cow_service.errors import (
    CowError,
    FieldError,
    GeneratorUnavailable,
    ImageTypeUnsupported,
    InvalidRequest,
    ReaderUnavailable,
)
from cow_service.generators.base import Generator
from cow_service.media.artifacts import ArtifactStore
from cow_service.media.images import DecodedImage, decode
from cow_service.net.images import ImageUrls
from cow_service.observability.metrics import Metrics
from cow_service.pipeline import Backends, Progress, Stamp, StillWanted, answer, ignore_progress, simulate
from cow_service.readers.base import Reader
from cow_service.records import Answer, Artifact, BackendInfo, Models, Simulation
from cow_service.registry import Registry
from cow_service.requests import AnswerRequest, ImageArtifact, ImageRef, ImageUrl, SimulateRequest
from cow_service.settings import Settings, SettingsError
from cow_service.stages.checks import check_frames, read_options
from cow_service.stages.results import Checkpoints, keep_nothing
from cow_service.weights.lock import ready, weights_identity
from cow_service.weights.manifests import find_manifest, load_manifests

OWN_PARTS = frozenset(("transformer", "weights"))  # what a checkpoint of one's own can stand in for
_OTHER_URL = re.compile(r"(?!data:)[a-z][a-z0-9+.-]*:", re.IGNORECASE | re.ASCII)
_DATA_URL = re.compile(r"data:(?P<type>[\w.+/-]*)(?:;[\w.+-]+=[^;,]*)*(?P<base64>;base64)?,", re.ASCII)


def always_wanted() -> None:
    """Nobody ends it."""


class Service:
    """Everything a server or a command line needs, made once. Safe to use from several threads.

    `COW_CONCURRENCY` of them compute at the same time; whoever waits for a multimodal LLM lets another one compute.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.slots = Turns(settings.concurrency)  # who computes
        self._turns: dict[str, Turns] = {}  # of generators that take only so many clips at the same time
        self._identities: dict[str, str] = {}
        self._guard = Lock()
        self.metrics = Metrics()
        self._image_urls = ImageUrls(settings)
        self.artifacts = ArtifactStore(settings.data_dir / "artifacts")
        self.readers: Registry[Reader] = Registry("cow_service.readers", ReaderUnavailable, settings)
        self.generators: Registry[Generator] = Registry("cow_service.generators", GeneratorUnavailable, settings)
        for setting, name, names in (
            ("COW_READER", settings.reader, self.readers.names()),
            ("COW_GENERATOR", settings.generator, self.generators.names()),
        ):
            if name not in names:
                raise SettingsError(f"Bad settings: {setting}={name!r}: there are only {', '.join(names) or 'none'}.")
        for name in settings.checkpoints:
            manifest = find_manifest(name)
            if manifest is None or not OWN_PARTS & manifest.sources.keys():
                loadable = [name for name, each in load_manifests().items() if OWN_PARTS & each.sources.keys()]
                raise SettingsError(f"Bad settings: COW_CHECKPOINTS for {name!r}: only for {', '.join(loadable)}.")

    def keep_image(self, data: bytes) -> tuple[Artifact, DecodedImage]:
        """Decodes an image (PNG, JPEG or WebP) and keeps its bytes as sent. Raises the errors of `images.decode`."""
        image = decode(data, max_megapixels=self.settings.max_image_megapixels)
        return self.artifacts.put(data, image.media_type), image

    def simulate(
        self,
        request: SimulateRequest,
        progress: Progress = ignore_progress,
        image: DecodedImage | None = None,
        checkpoints: Checkpoints = keep_nothing,
        stamp: Stamp | None = None,
        still_wanted: StillWanted = always_wanted,
    ) -> Simulation:
        """One simulation, start to end; `image` is that of the request where it was decoded before.

        Who asked first computes first; `still_wanted` may end the wait. Raises any `CowError` of its stages.
        """
        stamp = stamp or Stamp()
        backends = self._backends(request, stamp.created_at)
        with self.slots.held(stamp.created_at, still_wanted):
            image = image or self.image_of(request.image)[1]
            return simulate(request, image, backends, progress, checkpoints, stamp)

    def answer(
        self,
        request: AnswerRequest,
        progress: Progress = ignore_progress,
        image: DecodedImage | None = None,
        checkpoints: Checkpoints = keep_nothing,
        stamp: Stamp | None = None,
        still_wanted: StillWanted = always_wanted,
    ) -> Answer:
        """One answer, start to end; `image` is that of the request where it was decoded before.

        Who asked first computes first; `still_wanted` may end the wait. Raises any `CowError` that leaves no answer.
        """
        stamp = stamp or Stamp()
        backends = self._backends(request, stamp.created_at)
        with self.slots.held(stamp.created_at, still_wanted):
            image = image or self.image_of(request.image)[1]
            return answer(request, image, backends, progress, checkpoints, stamp)

    def precheck(self, request: SimulateRequest) -> tuple[str, str]:
        """Says at once what is wrong with a request as far as that costs nothing; returns its reader and generator.

        Raises `InvalidRequest` for backends that nobody has and for options that the generator does not take, and
        `ReaderUnavailable` or `GeneratorUnavailable` where their modules are not installed.
        """
        reader = self._known("reader", request.reader or self.settings.reader, self.readers)
        name = self._known("generator", request.generator or self.settings.generator, self.generators)
        _check_modules(reader, ReaderUnavailable)
        _check_modules(name, GeneratorUnavailable)
        if self.generators.is_made(name) or name == self.settings.generator:
            generator = self._generator(name)
            read_options(generator, request.generator_options)
            check_frames(generator, request)
        return reader, name

    def models(self) -> Models:
        """Readers and generators, what each needs, and whether it is ready."""
        return Models(
            readers=tuple(self._describe("reader", name) for name in self.readers.names()),
            generators=tuple(self._describe("generator", name) for name in self.generators.names()),
            mllms=tuple(name for name, manifest in load_manifests().items() if manifest.role == "mllm"),
        )

    def __enter__(self) -> Service:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Lets go of what its backends hold open, such as connections."""
        self.readers.close()
        self.generators.close()

    def check(self) -> None:
        """Raises the `CowError` that would keep the default request from succeeding."""
        self.artifacts.check()
        self._reader(self.settings.reader)
        self._generator(self.settings.generator)

    def _backends(self, request: SimulateRequest, rank: str) -> Backends:
        """Who does the work of a request. Raises `InvalidRequest` for a name that nobody has."""
        reader = self._known("reader", request.reader or self.settings.reader, self.readers)
        generator = self._known("generator", request.generator or self.settings.generator, self.generators)
        return Backends(
            reader_name=reader,
            reader=lambda: self._reader(reader),
            generator=lambda: self._generator(generator),
            artifacts=self.artifacts,
            weights=partial(self._weights, generator),
            elsewhere=partial(self.slots.left, rank),
            rendering=partial(self._rendering, generator, rank),
        )

    def _weights(self, name: str) -> str:
        """What told a generator's weights from others when they were loaded: files may have changed since."""
        return self._identities.get(name, "")

    @contextmanager
    def _rendering(self, name: str, rank: str, still_wanted: StillWanted) -> Steps[None]:
        """Holds a generator's turn. While waiting for it, and while it works, the slot is left to others."""
        at_once = self.settings.generator_concurrency.get(name, getattr(self._generator(name), "concurrency", None))
        if at_once is None:
            yield
            return
        with self._guard:
            turns = self._turns.setdefault(name, Turns(at_once))
        with self.slots.left(rank), turns.held(rank, still_wanted):
            yield

    def _reader(self, name: str) -> Reader:
        _check_modules(name, ReaderUnavailable)
        return self.readers.get(name)

    def _generator(self, name: str) -> Generator:
        _check_modules(name, GeneratorUnavailable)
        manifest = find_manifest(name)
        if manifest is not None and not self.generators.is_made(name):
            self._identities[name] = weights_identity(manifest, self.settings)
        return self.generators.get(name)

    def image_of(self, ref: ImageRef) -> tuple[str, DecodedImage]:
        """The image that a request means: its SHA-256 as kept here, and its pixels.

        Raises `ArtifactNotFound`, `ImageUrlNotAllowed`, and what `keep_image` raises.
        """
        if isinstance(ref, ImageUrl) or (isinstance(ref, str) and _OTHER_URL.match(ref[:256])):
            artifact, image = self.keep_image(self._image_urls.fetch(ref.url if isinstance(ref, ImageUrl) else ref))
            return artifact.sha256, image
        if isinstance(ref, ImageArtifact):
            self.artifacts.touch(ref.artifact)
            data = self.artifacts.read(ref.artifact)
            return ref.artifact, decode(data, max_megapixels=self.settings.max_image_megapixels)
        artifact, image = self.keep_image(decode_data_url(ref))
        return artifact.sha256, image

    def _known(self, door: str, name: str, registry: Registry[Reader] | Registry[Generator]) -> str:
        if name not in registry.names():
            detail = f"There is no {door} '{name}'. There are: {', '.join(registry.names()) or 'none'}."
            raise InvalidRequest(detail, errors=(FieldError(f"/{door}", detail),))
        return name

    def _describe(self, door: str, name: str) -> BackendInfo:
        manifest = find_manifest(name)
        default = name == (self.settings.reader if door == "reader" else self.settings.generator)
        if manifest is None:
            return BackendInfo(name=name, default=default, ready=None, summary="Registered by another package.")
        modules = manifest.missing_modules()
        unset = tuple(name for name in manifest.settings if not self.settings.has(name))
        here = ready(manifest, self.settings.weights_dir, without=self.settings.own_parts(name))
        return BackendInfo(
            name=name,
            default=default,
            ready=here and not modules and not unset,
            needs=manifest.modules,
            summary=manifest.summary,
            licence=manifest.licence,
            weights=manifest.weights,
            missing=(*modules, *unset),
            install=manifest.install_line() if modules else None,
            pull=None if here else f"cow models pull {name}",
            defaults=manifest.defaults,
        )


def _check_modules(name: str, unavailable: type[CowError]) -> None:
    """Raises `unavailable`, with the command that helps, where a backend's modules are not installed."""
    manifest = find_manifest(name)
    if manifest is not None and (missing := manifest.missing_modules()):
        raise unavailable(
            f"'{name}' needs {', '.join(missing)}, not installed on this server: {manifest.install_line()}"
        )


def decode_data_url(url: str) -> bytes:
    """The bytes of a base64 data URL; blanks and line ends in it are skipped.

    Raises `InvalidRequest` pointing at `/image`, and `ImageTypeUnsupported` where it declares something else.
    """
    head = _DATA_URL.match(url[:256])
    if head is None or head["base64"] is None:
        raise _bad_image("`image` must be a data URL with base64: data:image/png;base64,...")
    declared = head["type"].lower()
    if not declared.startswith("image/") and declared not in ("", "application/octet-stream"):
        # Of the image types, what the bytes are counts, and not what they are declared to be.
        raise ImageTypeUnsupported(
            f"The data URL of `image` declares {declared[:80]}: send image/png, image/jpeg or image/webp."
        )
    try:
        # Tools that write base64 break it into lines.
        return base64.b64decode("".join(url[head.end() :].split()), validate=True)
    except (binascii.Error, ValueError) as error:
        raise _bad_image(
            f"The base64 of `image` cannot be decoded ({error}): encode the file's bytes in the standard alphabet."
        ) from error


def _bad_image(detail: str) -> CowError:
    return InvalidRequest(detail, errors=(FieldError("/image", detail),))
