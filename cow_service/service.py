"""The composition root: settings in, a service that simulates out. Nothing else chooses a backend."""

from __future__ import annotations

import base64
import binascii
import re
from collections.abc import Generator as Steps
from contextlib import contextmanager
from threading import BoundedSemaphore

from cow_service.artifacts import ArtifactStore
from cow_service.errors import (
    CowError,
    FieldError,
    GeneratorUnavailable,
    ImageUrlNotAllowed,
    InvalidRequest,
    ReaderUnavailable,
)
from cow_service.generators.base import Generator
from cow_service.images import DecodedImage, decode
from cow_service.manifests import find_manifest, load_manifests
from cow_service.pipeline import Backends, Progress, answer, simulate
from cow_service.plugins import Registry
from cow_service.readers.base import Reader
from cow_service.records import Answer, Artifact, BackendInfo, Models, Simulation
from cow_service.requests import AnswerRequest, ImageArtifact, ImageRef, ImageUrl, SimulateRequest
from cow_service.settings import Settings, SettingsError
from cow_service.weights import ready

OWN_PARTS = frozenset(("transformer", "weights"))  # what a checkpoint of one's own can stand in for
_DATA_URL = re.compile(r"data:(?P<type>[\w.+/-]*)(?:;[\w.+-]+=[^;,]*)*(?P<base64>;base64)?,", re.ASCII)


def _ignore(stage: str, done: float) -> None:
    """Nobody listens."""


class Service:
    """Everything a server or a command line needs, made once. Safe to use from several threads.

    `COW_CONCURRENCY` of them compute at the same time; whoever waits for a multimodal LLM lets another one compute.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self._slots = BoundedSemaphore(settings.concurrency)
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
        self, request: SimulateRequest, progress: Progress = _ignore, image: DecodedImage | None = None
    ) -> Simulation:
        """One simulation, start to end; `image` is that of the request where it was decoded before.

        Raises any `CowError` of its stages.
        """
        backends = self._backends(request)
        with self._slots:
            return simulate(request, image or self._image(request.image), backends, progress)

    def answer(self, request: AnswerRequest, progress: Progress = _ignore, image: DecodedImage | None = None) -> Answer:
        """One answer, start to end; `image` is that of the request where it was decoded before.

        Raises any `CowError` that leaves no answer.
        """
        backends = self._backends(request)
        with self._slots:
            return answer(request, image or self._image(request.image), backends, progress)

    def models(self) -> Models:
        """Readers and generators, what each needs, and whether it is ready."""
        return Models(
            readers=tuple(self._describe("reader", name) for name in self.readers.names()),
            generators=tuple(self._describe("generator", name) for name in self.generators.names()),
            mllms=tuple(name for name, manifest in load_manifests().items() if manifest.door == "mllm"),
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

    def _backends(self, request: SimulateRequest) -> Backends:
        """Who does the work of a request. Raises `InvalidRequest` for a name that nobody has."""
        reader = self._known("reader", request.reader or self.settings.reader, self.readers)
        generator = self._known("generator", request.generator or self.settings.generator, self.generators)
        return Backends(
            reader_name=reader,
            reader=lambda: self._reader(reader),
            generator=lambda: self._generator(generator),
            artifacts=self.artifacts,
            elsewhere=self._elsewhere,
        )

    @contextmanager
    def _elsewhere(self) -> Steps[None]:
        """Leaves the slot to others while somebody else computes for us."""
        self._slots.release()
        try:
            yield
        finally:
            self._slots.acquire()

    def _reader(self, name: str) -> Reader:
        _check_modules(name, ReaderUnavailable)
        return self.readers.get(name)

    def _generator(self, name: str) -> Generator:
        _check_modules(name, GeneratorUnavailable)
        return self.generators.get(name)

    def _image(self, ref: ImageRef) -> DecodedImage:
        if isinstance(ref, ImageUrl) or (isinstance(ref, str) and ref[:8].lower().startswith(("http://", "https://"))):
            raise ImageUrlNotAllowed("This server fetches no images. Send the image as a data URL or as a file part.")
        if isinstance(ref, ImageArtifact):
            return decode(self.artifacts.read(ref.artifact), max_megapixels=self.settings.max_image_megapixels)
        return self.keep_image(decode_data_url(ref))[1]

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
    """The bytes of a base64 data URL. Raises `InvalidRequest` pointing at `/image`."""
    head = _DATA_URL.match(url[:256])
    if head is None or head["base64"] is None:
        raise _bad_image("`image` must be a data URL with base64: data:image/png;base64,...")
    try:
        return base64.b64decode(url[head.end() :], validate=True)
    except (binascii.Error, ValueError) as error:
        raise _bad_image(f"The base64 of `image` cannot be decoded: {error}.") from error


def _bad_image(detail: str) -> CowError:
    return InvalidRequest(detail, errors=(FieldError("/image", detail),))
