"""The reader that asks a multimodal LLM. A simulation takes two calls, or one; an answer takes one more."""

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

from cow_service import __version__, records
from cow_service.errors import CannotReadDirection, CowError, ObjectNotFound
from cow_service.physics.camera import depth_motion
from cow_service.readers import base
from cow_service.readers.base import GroundingReading, MotionHints, MotionReading, ReaderInput
from cow_service.readers.chat import ChatTurn
from cow_service.readers.mllm.answer import VOTING_TEMPERATURE, answer_calls
from cow_service.readers.mllm.check import MllmCheck, check_model
from cow_service.readers.mllm.client import MllmClient, PromptCall
from cow_service.readers.mllm.contents import pictures
from cow_service.readers.mllm.coordinates import EncodedImage, encode
from cow_service.readers.mllm.identify import SAID_ALIKE, Identified, identified_by_words, identify_call
from cow_service.readers.mllm.known import UNKNOWN, USUAL
from cow_service.readers.mllm.locate import DOWN, Line, Located, Scale, locate_call, scale_call, separate_objects
from cow_service.readers.mllm.models import configure
from cow_service.readers.mllm.replies import name_words
from cow_service.readers.remedies import GIVE_DIRECTION, GIVE_OBJECT, GIVE_PLACE
from cow_service.settings import Settings
from cow_service.weights.manifests import PROMPTS

CAMERA_SENSE = {"towards": -1.0, "away": 1.0}
DEFAULT_KIND: records.MotionKind = "linear"
DEFAULT_REASONING_LENGTH = 2000  # characters, where the manifest says nothing else


class MllmReader:
    """Asks one model for everything. It keeps its connections, but no readings."""

    source: records.Source = "mllm"

    def __init__(self, name: str, client: MllmClient, origin: str = "") -> None:
        """`origin` says which server, or which weights."""
        self._client, self.places = client, client.places
        self._model = client.model
        self.upstream = self._model.upstream
        self._origin = origin
        self._subject = f"The multimodal LLM '{self._model.name}'"
        defaults = self._model.manifest.defaults
        self._reasoning = int(defaults.get("max_reasoning", DEFAULT_REASONING_LENGTH))
        self._measured = client.measured or USUAL
        self.info = records.ReaderInfo(name=name, model=self._model.name)
        taken = f"by its name it was taken for one of the family '{self._model.family.name}'"
        if self._model.family.name == UNKNOWN:
            taken = "coordinates were asked for as fractions, and a model that is used to others may have given those"
        warning = f"No manifest describes '{self._model.name}': {taken}."
        is_known = self._model.manifest.name != UNKNOWN or client.measured is not None
        self._family_warnings = () if is_known else (warning,)

    @cached_property
    def fingerprint(self) -> str:
        """The model, where it is served from, how its family is asked, and the words of all prompts."""
        parts = (
            __version__, self.info.name, self._model.name, self._origin, self._model.manifest.model_dump_json(),
            self._client.family.model_dump_json(), self._measured.model_dump_json(),
            *map(PROMPTS.read, PROMPTS.names()),
        )  # fmt: skip
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()

    heeds_seed = True
    heeds_objections = True

    def repeats_answers(self, votes: int) -> bool:
        """True only for a model that is deterministic at temperature 0, if it is asked with that."""
        temperature = VOTING_TEMPERATURE if votes > 1 else self._model.manifest.defaults.get("temperature")
        return self._model.deterministic and temperature == 0

    def check(self) -> MllmCheck:
        """Asks small questions about pictures whose answers are known. Raises `MllmUnavailable`."""
        return check_model(self._client, self._reasoning)

    def keep(self, measured: records.MllmMeasurement) -> None:
        """Keeps what a check has measured, for readers that are made from now on. Raises `OSError`."""
        self._client.notes.keep(measured)

    def close(self) -> None:
        """Closes its connections."""
        self._client.close()

    @property
    def takes(self) -> records.ServerCapabilities | None:
        """What was learned of its server, by this process or another."""
        return self._client.notes.takes or self._client.capabilities.proven

    async def chat(self, body: dict[str, Any]) -> ChatTurn:
        """The reply to a chat of OpenAI's protocol, through pydantic-ai. Raises `InvalidRequest`, `MllmUnavailable`."""
        return await self._client.chat(body)

    def ground(self, given: ReaderInput) -> GroundingReading:
        """Two calls: what moves, unless the question's words say it; then where it is and which way it moves.

        Raises `ObjectNotFound`, `MllmBadReply`, `MllmUnavailable`.
        """
        image, identified = self._identify(given)
        if identified is None:
            raise ObjectNotFound(
                f"{self._subject} sees nothing in the image that the question could move.", remedy=GIVE_PLACE
            )
        located, scale = self._locate(given, image, identified, identified.object)
        if located is None:
            raise ObjectNotFound(f"{self._subject} does not see '{identified.object}' in the image.", remedy=GIVE_PLACE)
        with given.cpu():
            bbox = given.scene.bbox_at(located.point or (0.0, 0.0)) if located.bbox is None else located.bbox
        mover = records.LocatedObject(object=identified.object, bbox=bbox, source="mllm")
        others, doubles = separate_objects(mover, located.others)
        known = {name_words(each.object): each for each in (mover, *others)}

        def changed(name: str) -> records.LocatedObject:
            found = known.get(name_words(name))
            if found is None:
                raise ObjectNotFound(
                    f"{self._subject} does not see '{name}' in the image, which the question changes.",
                    remedy=GIVE_PLACE,
                )
            return found.model_copy(update={"role": "target"})

        interventions = tuple(
            records.Intervention(
                kind=one.kind,
                object=changed(one.object),
                relation=one.relation,
                targets=tuple(map(changed, one.targets)),
            )
            for one in identified.changes
        )
        removed = {each.object.bbox for each in interventions if each.kind == "remove"}
        is_other = bool(located.label) and set(name_words(located.label)).isdisjoint(name_words(identified.object))
        mismatch = f"Asked for '{identified.object}', the reader gave a place that it calls '{located.label}'."
        warnings = (*((mismatch,) if is_other else ()), *identified.warnings, *located.warnings, *doubles)
        return GroundingReading(
            object=identified.object,
            bbox=bbox,
            bbox_deviation=self._measured.bbox_deviation,
            label=located.label,
            point=located.point,
            others=tuple(other for other in others if other.bbox not in removed),
            objects_complete=located.objects_complete and not doubles,
            interventions=interventions,
            warnings=warnings,
            place_doubts=self._family_warnings,
            is_doubtful=is_other,
            asked_is_doubtful=bool(identified.warnings),
            hints=_hints(identified, located, scale, bbox) if given.motion_wanted else None,
            asked=identified.asked,
            language=identified.language,
        )

    def read_motion(self, given: ReaderInput, grounding: records.Grounding, hints: MotionHints | None) -> MotionReading:
        """No call with hints, one where something speaks against them, else two.

        Raises `CannotReadDirection`, `MllmBadReply`, `MllmUnavailable`.
        """
        warnings: list[str] = []
        others_sought = hints is not None  # with the mover
        if hints is None:
            image, identified = self._identify(replace(given, asked_wanted=False, changes_wanted=False))
            located, scale = self._locate(given, image, identified, grounding.object, grounding.bbox)
            hints = _hints(identified, located, scale, grounding.bbox)
            warnings += () if identified is None else identified.warnings
            warnings += () if located is None else located.warnings
        elif given.objections and hints.kind in records.DIRECTED_KINDS:
            with given.cpu():
                image = encode(given.scene.image, self._client.family)
            call = locate_call(given, image, grounding.object, grounding.bbox, (), True, self._reasoning)
            if (located := self._client.complete(call, given)) is not None:
                warnings += located.warnings
                hints = hints.model_copy(update=vars(located.line or Line()))
        places = {name_words(each.object): each for each in grounding.others}
        others: list[base.OtherMotionReading] = []
        for hint in hints.also:
            place = places.get(name_words(hint.object))
            if place is not None:
                width = self._measured.direction_deviation
                others.append(base.OtherMotionReading(place, hint.kind, hint.direction, width, hint.depth))
            elif others_sought:
                raise CannotReadDirection(f"'{hint.object}' moves, too, and was not found.", remedy=GIVE_DIRECTION)
            else:
                warnings.append(f"'{hint.object}' moves, too, and was left out: it has no place. {GIVE_OBJECT}")
        kind = hints.kind or DEFAULT_KIND
        reading = MotionReading(kind, None, "text", others=tuple(others))
        if kind in records.FALLING_KINDS:
            reading = replace(reading, cue="gravity", metres_per_pixel=hints.metres_per_pixel, down=hints.down)
            if hints.scale_error:
                default = "the default one was taken"
                warnings.append(f"The scale of the scene could not be read ({hints.scale_error}): {default}.")
        reading = replace(reading, warnings=tuple(warnings))
        return self._directed(reading, hints) if kind in records.DIRECTED_KINDS else reading

    def answer(
        self,
        given: ReaderInput,
        options: Sequence[records.AnswerOption],
        grounding: records.Grounding | None,
        imagined: base.Imagined | None,
        votes: int,
    ) -> tuple[base.AnswerReading, ...]:
        """One call per vote, all at the same time. Raises `MllmBadReply`, `MllmUnavailable` if all of them fail."""
        with given.cpu():
            pixels = (given.scene.image, *(() if imagined is None else pictures(imagined)))
            jpegs = tuple(encode(each, self._client.family).jpeg for each in pixels)
        calls = answer_calls(given.question, options, jpegs, imagined, votes, self._reasoning)
        results = self._client.complete_all(calls, given)
        readings = tuple(each for each in results if not isinstance(each, CowError))
        if not readings:
            raise next(each for each in results if isinstance(each, CowError))
        return tuple(replace(each, notes=(*each.notes, *given.calls.notes)) for each in readings)

    def _identify(self, given: ReaderInput) -> tuple[EncodedImage, Identified | None]:
        """The image as it is sent, and the question about it; of several arrows the MLLM says which one is meant."""
        with given.cpu():
            image = encode(given.scene.image, self._client.family)
            said = identified_by_words(given) if given.words and len(given.scene.arrows) <= 1 else None
        return image, said or self._client.complete(identify_call(given, image, self._reasoning), given)

    def _locate(
        self,
        given: ReaderInput,
        image: EncodedImage,
        identified: Identified | None,
        name: str,
        bbox: records.BBox | None = None,
    ) -> tuple[Located | None, Scale | CowError | None]:
        """Asks for the place, the direction and, of what falls, the scale, as far as they are needed; all at once.

        None for what was not asked for, or not seen. Raises `MllmBadReply`, `MllmUnavailable`.
        """
        kind = (identified.kind if identified else None) or DEFAULT_KIND
        others: tuple[str, ...] = ()
        if identified is not None and bbox is None:
            named = (*identified.must_be_found, *given.sought, *identified.others)
            others = tuple(dict.fromkeys(each for each in named if name_words(each) != name_words(name)))
        wants_direction = given.motion_wanted and kind in records.DIRECTED_KINDS
        calls: dict[str, PromptCall[Any]] = {}
        if bbox is None or wants_direction:
            calls["place"] = locate_call(given, image, name, bbox, others, wants_direction, self._reasoning)
        if given.motion_wanted and kind in records.FALLING_KINDS:
            calls["scale"] = scale_call(image, name, self._reasoning)
        results = dict(zip(calls, self._client.complete_all(list(calls.values()), given), strict=True))
        located: Located | CowError | None = results.get("place")
        if isinstance(located, CowError):
            raise located
        return located, results.get("scale")

    def _directed(self, reading: MotionReading, hints: MotionHints) -> MotionReading:
        deviation = self._measured.direction_deviation
        said: dict[str, Any] = {name: getattr(hints, name) for name in SAID_ALIKE}
        said |= {"steps": hints.then, "cue": hints.cue or "orientation", "direction_deviation": deviation}
        if hints.camera is not None:
            said["direction"], said["depth"] = depth_motion(CAMERA_SENSE[hints.camera])
            said["depth_deviation"] = deviation
        elif hints.ends is not None:
            (x0, y0), (x1, y1) = hints.ends
            said["direction"] = (x1 - x0, y1 - y0)
        return replace(reading, along_arrow=hints.along_arrow, **said)


def _hints(
    identified: Identified | None, located: Located | None, scale: Scale | CowError | None, bbox: records.BBox
) -> MotionHints:
    hints: dict[str, Any] = {"kind": DEFAULT_KIND} if identified is None else identified.hints
    if located is not None and located.line is not None:
        hints |= vars(located.line)
    if isinstance(scale, Scale):
        name = "" if identified is None else identified.object
        hints |= {"metres_per_pixel": scale.metres_per_pixel(name, bbox), "down": DOWN[scale.down]}
    elif isinstance(scale, CowError):
        hints["scale_error"] = scale.code
    return MotionHints(**hints)


def create(settings: Settings) -> MllmReader:
    """Factory for the registry. Raises `ReaderUnavailable` if COW_MLLM cannot be used."""
    return MllmReader("mllm", MllmClient(configure(settings), settings), settings.mllm_base_url or "")
