"""The composition root: settings in, a service that simulates out. Nothing else chooses a backend."""

import hashlib
import re
import uuid
from collections.abc import Iterable
from functools import partial
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from threading import Lock
from typing import Any, Self, TypeVar, cast

from cow_service import errors, requests
from cow_service.concurrency import PrioritySemaphore
from cow_service.generators.base import Generator, Limits
from cow_service.media.artifacts import ArtifactStore, DiskArtifacts, RetryPolicy, media_type_of, try_once
from cow_service.media.images import check, decode, decode_data_url
from cow_service.net import ImageUrls
from cow_service.observability.metrics import Metrics
from cow_service.perception.base import GROUPS, Perception
from cow_service.perception.observation import SeenImages
from cow_service.pipeline import answer, simulate
from cow_service.readers.base import Reader, WordReader
from cow_service.readers.chat import CallsMllm, ChatReader
from cow_service.readers.mllm.known import status_of
from cow_service.records import Answer, Artifact, BackendInfo, BackendKind, Look, Models, Simulation, WorkerLoad
from cow_service.registry import Registry
from cow_service.requests import AnswerRequest, SimulateRequest
from cow_service.settings import Settings, SettingsError
from cow_service.stages import run as runs
from cow_service.stages.looking import look
from cow_service.weights.manifests import check_modules, find_manifest, load_manifests
from cow_service.weights.repositories import ready

OWN_PARTS = frozenset(("transformer", "weights"))  # backends that an own checkpoint can replace
WORD_READER = "embedded"  # it needs no weights: it reads the words of requests whose images another reader looks at
Request = TypeVar("Request", bound=SimulateRequest)
Place = TypeVar("Place", bound=requests.PlaceRequest)
File = tuple[bytes, str]
"""Bytes to be kept, and their media type."""
_OTHER_URL = re.compile(r"(?!data:)[a-z][a-z0-9+.-]*:", re.IGNORECASE | re.ASCII)


class Service:
    """Everything a server or a command line needs, made once. Safe to use from several threads.

    `COW_CONCURRENCY` of them compute on the CPU at the same time; waits for a multimodal LLM do not count.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.cpu = PrioritySemaphore(settings.concurrency)  # held around work on the CPU
        self._devices: dict[str, PrioritySemaphore] = {}  # of generators with a limit of simultaneous clips
        self._guard = Lock()
        self.metrics = Metrics()
        self.image_urls = ImageUrls(settings)
        self.artifacts = open_artifact_store(settings)
        self.perception = Perception(settings)
        self.seen = SeenImages(self.perception)  # what jobs have seen in images, for those that come with the same
        self.readers: Registry[Reader] = Registry("cow_service.readers", errors.ReaderUnavailable, settings)
        self._generator_limits = {point.name: point for point in entry_points(group="cow_service.generator_limits")}
        self.generators: Registry[Generator] = Registry("cow_service.generators", errors.GeneratorUnavailable, settings)
        for setting, name, names in (
            ("COW_READER", settings.reader, self.readers.names()),
            ("COW_GENERATOR", settings.generator, self.generators.names()),
        ):
            if name not in names:
                raise SettingsError(f"Bad settings: {setting}={name!r}: known are {', '.join(names) or 'none'}.")
        for name in settings.checkpoints:
            manifest = find_manifest(name)
            if manifest is None or not OWN_PARTS & manifest.sources.keys():
                loadable = [name for name, each in load_manifests().items() if OWN_PARTS & each.sources.keys()]
                raise SettingsError(f"Bad settings: COW_CHECKPOINTS for {name!r}: only for {', '.join(loadable)}.")

    def keep_image(self, data: bytes) -> Artifact:
        """Keeps an image (PNG, JPEG or WebP) as sent, not decoded. Raises the errors of `images.check`."""
        return self.artifacts.put(data, self.check_image(data))

    def check_image(self, data: bytes) -> str:
        """The media type of an image that may be decoded, as its header shows. Raises the errors of `images.check`."""
        return check(data, max_megapixels=self.settings.max_image_megapixels)

    def simulate(self, request: SimulateRequest, progress: runs.Progress = runs.ignore_progress) -> Simulation:
        """One simulation, start to end. Raises any `CowError` of its stages. Arguments as for `prepare`."""
        return simulate(self.prepare(request, progress))

    def answer(self, request: AnswerRequest, progress: runs.Progress = runs.ignore_progress) -> Answer:
        """One answer, start to end. Raises any `CowError` that leaves no answer. Arguments as for `prepare`."""
        return answer(self.prepare(request, progress))

    def prepare(
        self,
        request: Request,
        progress: runs.Progress = runs.ignore_progress,
        step: runs.Step = runs.compute_directly,
        retry_policy: RetryPolicy = try_once,
        run_id: str | None = None,
        created_at: str | None = None,
        turn: int = 0,
    ) -> runs.Run[Request]:
        """A run of the request, with its backends and its image, which is decoded here.

        Runs compute by `turn`, then first in, first out by `created_at` (RFC 3339, by default now).

        Raises `InvalidRequest` for unknown backends, the errors of `digested` and of `images.decode`,
        and whatever `progress` raises.
        """
        reader, generator = self._names_of(request)
        backends = runs.Backends(
            reader_name=reader,
            reader=partial(self._reader, reader),
            words=lambda: cast(WordReader, self.readers.get(WORD_READER)),
            generator=partial(self._generator, generator),
            artifacts=self.artifacts,
            perception=self.perception,
            cpu=self.cpu,
            device=partial(self._device, generator),
        )
        request, files = self.digested(request)
        self.keep(files)
        created_at = created_at or runs.now()
        # A run begins in its turn, and its job counts as queued until then.
        with self.cpu.held(runs.priority_of(turn, created_at), partial(progress, None, 0.0)):
            image = decode(self.fetch(request.image), max_megapixels=self.settings.max_image_megapixels)
        return runs.Run(
            request, image, backends, progress, step, retry_policy, run_id or str(uuid.uuid4()), created_at, turn
        )

    def digested(self, request: Request, image: bytes | None = None) -> tuple[Request, list[File]]:
        """The request with its pictures by their digests, and the bytes to keep for it; nothing is kept yet.

        `image`: the bytes of its image, where they came apart from it. Raises `InvalidRequest`, the errors of `fetch`
        and of `images.check`. Masks are not decoded before they are needed.
        """
        files: list[File] = []
        changed: dict[str, Any] = {}

        def digest(data: bytes, media_type: str) -> requests.ImageArtifact:
            files.append((data, media_type))
            return requests.ImageArtifact(artifact=hashlib.sha256(data).hexdigest())

        def png_digest(url: str, pointer: str) -> requests.ImageArtifact:
            data = decode_data_url(url, pointer)
            if media_type_of(data) != "image/png":
                detail = "is no PNG"
                raise errors.InvalidRequest(
                    f"`{errors.field_of(pointer)}` {detail}: save it as one.",
                    errors=(errors.FieldError(pointer, detail),),
                )
            return digest(data, "image/png")

        def with_digest(place: Place, pointer: str) -> Place:
            if not isinstance(place.mask, str):
                return place
            return place.model_copy(update={"mask": png_digest(place.mask, pointer)})

        if image is None and not isinstance(request.image, requests.ImageArtifact):
            image = self.fetch(request.image)
        if image is not None:
            changed["image"] = digest(image, self.check_image(image))
        if request.grounding is not None:
            changed["grounding"] = with_digest(request.grounding, "/grounding/mask")
        if request.objects:
            changed["objects"] = tuple(
                with_digest(given, f"/objects/{index}/mask") for index, given in enumerate(request.objects)
            )
        if request.depth is not None and isinstance(request.depth.map, str):
            map_ = png_digest(request.depth.map, "/depth/map")
            changed["depth"] = request.depth.model_copy(update={"map": map_})
        return request.model_copy(update=changed), files

    def keep(self, files: Iterable[File]) -> None:
        """Keeps what `digested` found. Raises `StorageUnavailable`."""
        for data, media_type in files:
            self.artifacts.put(data, media_type)

    def fetch(self, ref: requests.ImageRef) -> bytes:
        """The bytes of an image. Raises `InvalidRequest`, `ImageUrlNotAllowed`, `ImageUrlUnreachable`,
        `ArtifactNotFound`."""
        if isinstance(ref, requests.ImageArtifact):
            return self.artifacts.read(ref.artifact)
        url = ref.url if isinstance(ref, requests.ImageUrl) else ref
        return self.image_urls.fetch(url) if is_url(ref) else decode_data_url(url)

    def precheck(self, request: SimulateRequest) -> tuple[str, str]:
        """Makes the cheap checks of a request at once; returns its reader and generator.

        Raises `InvalidRequest` for unknown backends and for options that the generator does not take, and
        `ReaderUnavailable` or `GeneratorUnavailable` where their modules are needed here and not installed.
        """
        reader, name = self._names_of(request)
        if self.settings.role != "api":  # otherwise workers have what this process lacks
            check_modules(reader, errors.ReaderUnavailable)
            check_modules(name, errors.GeneratorUnavailable)
            for model in self.perception.names.values():
                check_modules(model, errors.PerceptionMissing)
        limits: Limits | None = None  # where only the generator itself knows them, and it is not loaded
        if name in self._generator_limits:
            limits = self._generator_limits[name].load()()
        elif self.generators.is_made(name) or name == self.settings.generator:
            limits = self._generator(name)
        if limits is not None:
            runs.check_request(limits, request)
        return reader, name

    def look(self, request: requests.LookRequest, owner: str | None = None, image: bytes | None = None) -> Look:
        """What the server's models see in an image; nothing is kept but in memory.

        `image`: the bytes of the request's image, where they came apart from it. An image by its SHA-256 is one that
        `owner` looked at before. Raises `PerceptionUnavailable`, `InvalidRequest`, `ArtifactNotFound` for an image that
        is not in memory any more, and the errors of `fetch` and `images.decode`.
        """
        if self.settings.role == "api":
            raise errors.PerceptionMissing("This server runs no models (COW_ROLE=api): give a box instead.")
        known = request.image.artifact if isinstance(request.image, requests.ImageArtifact) and image is None else None
        if known is None and image is None:
            image = self.fetch(request.image)

        key = owner, known or hashlib.sha256(image or b"").hexdigest()
        words = cast(WordReader, self.readers.get(WORD_READER))
        nouns = words.read_question(request.question).nouns if request.question is not None else ()
        most = self.settings.max_image_megapixels
        with self.cpu.held(runs.priority_of(0, runs.now()), lambda: None):
            return look(self.perception, self.seen, key, image, request, nouns, most)

    def load(self) -> WorkerLoad:
        """What its work waits for just now."""
        made = [self.readers.get(name) for name in self.readers.names() if self.readers.is_made(name)]
        places = [reader.places for reader in made if isinstance(reader, CallsMllm)]
        return WorkerLoad(
            cpu_waiting=self.cpu.waiting,
            mllm_calls=sum(one.limit.in_flight for one in places),
            mllm_limit=sum(one.limit.limit for one in places),
            mllm_waiting=sum(one.waiting for one in places),
        )

    def models(self) -> Models:
        """Readers and generators, what each needs, and whether it is ready."""
        return Models(
            readers=tuple(self._describe("reader", name) for name in self.readers.names()),
            generators=tuple(self._describe("generator", name) for name in self.generators.names()),
            perception=tuple(self._describe(kind, name) for kind, name in self.perception.installed()),
            mllms=tuple(name for name, manifest in load_manifests().items() if manifest.role == "mllm"),
            mllm=status_of(self.settings),
        )

    def chat_reader(self, name: str) -> ChatReader | None:
        """The reader of that name where an MLLM is behind it, which can be chatted with; else None.

        Raises `ReaderUnavailable`, and whatever loading the reader raises.
        """
        reader = self._reader(name)
        return reader if isinstance(reader, ChatReader) else None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Releases what its backends hold open, such as connections."""
        self.readers.close()
        self.generators.close()
        self.perception.close()

    def check(self) -> None:
        """Raises the `CowError` that would keep the default request from succeeding."""
        self.artifacts.check()
        self._reader(self.settings.reader)
        self._generator(self.settings.generator)
        for kind in self.perception.names:
            self.perception.load(kind)

    def _device(self, name: str) -> PrioritySemaphore:
        """Held while a generator works: one of its own where it has a device or a limit, else that of the CPU."""
        permits = self.settings.generator_concurrency.get(name, getattr(self._generator(name), "concurrency", None))
        if permits is None:
            return self.cpu
        with self._guard:
            return self._devices.setdefault(name, PrioritySemaphore(permits))

    def _reader(self, name: str) -> Reader:
        check_modules(name, errors.ReaderUnavailable)
        return self.readers.get(name)

    def _generator(self, name: str) -> Generator:
        check_modules(name, errors.GeneratorUnavailable)
        return self.generators.get(name)

    def _names_of(self, request: SimulateRequest) -> tuple[str, str]:
        """Its reader and its generator. Raises `InvalidRequest` for an unknown name."""
        reader, generator = request.reader or self.settings.reader, request.generator or self.settings.generator
        for role, name, registry in (("reader", reader, self.readers), ("generator", generator, self.generators)):
            if name not in registry.names():
                detail = f"There is no {role} '{name}'. There are: {', '.join(registry.names()) or 'none'}."
                raise errors.InvalidRequest(detail, errors=(errors.FieldError(f"/{role}", detail),))
        return reader, generator

    def _describe(self, kind: BackendKind, name: str) -> BackendInfo:
        manifest = find_manifest(name)
        roles = {"reader": self.settings.reader, "generator": self.settings.generator, **self.perception.names}
        default = name == roles.get(kind)
        if manifest is None:
            summary = "Registered by another package."
            return BackendInfo(name=name, kind=kind, default=default, ready=None, summary=summary)
        modules = manifest.missing_modules()
        unset = tuple(name for name in manifest.settings if not self.settings.has(name))
        here = ready(manifest, self.settings.weights_dir, without=self.settings.own_parts(name))
        sees = kind not in GROUPS or self.settings.role != "api"  # which looks at no picture itself
        return BackendInfo(
            name=name,
            kind=kind,
            default=default,
            ready=here and sees and not modules and not unset,
            needs=manifest.modules,
            summary=manifest.summary,
            licence=manifest.licence,
            weights=manifest.weights,
            missing=(*modules, *unset),
            install=manifest.install_line() if modules else None,
            pull=None if here else f"cow models pull {name}",
            defaults=manifest.defaults,
        )


def open_artifact_store(settings: Settings) -> ArtifactStore:
    """The store of COW_ARTIFACTS. Raises `SettingsError` if its library is missing or cannot be set up."""
    place = settings.artifacts
    if place is None or "://" not in place:
        return DiskArtifacts(Path(place).expanduser() if place else settings.data_dir / "artifacts")
    if find_spec("obstore") is None:
        raise SettingsError(
            f"Bad settings: COW_ARTIFACTS={place!r} needs obstore, not installed: {errors.install_line('objects')}."
        )
    from cow_service.media.object_artifacts import ObjectArtifacts  # noqa: PLC0415 - an optional library

    return ObjectArtifacts(place, settings.data_dir / "scratch")


def is_url(ref: requests.ImageRef) -> bool:
    """Whether an image must be fetched: it is given by a URL that holds no data."""
    return isinstance(ref, requests.ImageUrl) or (isinstance(ref, str) and _OTHER_URL.match(ref[:256]) is not None)
