"""The reader that asks a multimodal LLM. A simulation takes two calls, or one; an answer takes one more."""

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

from cow_service import __version__, records
from cow_service.errors import CannotReadDirection, CowError, ObjectNotFound
from cow_service.readers import base
from cow_service.readers.base import GIVE_DIRECTION, GIVE_OBJECT, GIVE_PLACE, ReaderInput, ReadResult
from cow_service.readers.chat import ChatTurn
from cow_service.readers.mllm.answer import VOTING_TEMPERATURE, answer_calls
from cow_service.readers.mllm.check import MllmCheck, check_model
from cow_service.readers.mllm.client import MllmClient, PromptCall
from cow_service.readers.mllm.contents import pictures
from cow_service.readers.mllm.coordinates import EncodedImage, encode
from cow_service.readers.mllm.identify import NOTHING_IDENTIFIED, Identified, identified_by_words, identify_call
from cow_service.readers.mllm.known import UNKNOWN, USUAL
from cow_service.readers.mllm.locate import UNKNOWN_SCALE, Scale, locate_call, scale_call, separate_objects
from cow_service.readers.mllm.models import configure
from cow_service.readers.mllm.replies import name_words
from cow_service.records import DIRECTED_KINDS, FALLING_KINDS
from cow_service.settings import Settings
from cow_service.weights.manifests import PROMPTS

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

    def read(self, given: ReaderInput) -> ReadResult:
        """Two calls: what moves, unless the question's words say it; then where it is and which way it moves.

        Only the second where the place and the kind of motion are known. Raises `ObjectNotFound`, `MllmBadReply`,
        `MllmUnavailable`.
        """
        with given.cpu():
            image = encode(given.image, self._client.family)
        place, motion = given.given.grounding, given.given.motion
        bbox = None if place is None else place.bbox
        known_kind = None if motion is None else motion.kind
        said = NOTHING_IDENTIFIED if known_kind is not None and bbox is not None else self._identify(given, image)
        name = (place.object if place is not None else None) or said.object
        if not name:
            fault = f"{self._subject} sees nothing in the image that the question could move."
            raise ObjectNotFound(fault, remedy=GIVE_PLACE)
        kind = known_kind or said.kind or DEFAULT_KIND
        located, scale = self._locate(given, image, said, name, kind, bbox)
        reading, warnings, place_doubts = records.Reading(), said.warnings, ()
        if bbox is None:
            reading, told = self._placed(given, name, said, located)
            bbox = None if reading.grounding is None else reading.grounding.bbox
            warnings, place_doubts = (*warnings, *told), self._family_warnings
        if given.motion_wanted:
            fields = said.motion | scale.motion_at(bbox)
            if kind in DIRECTED_KINDS:
                fields |= self._way(located.reading.motion)
            reading, left_out = self._with_motion(given, reading, fields)
            warnings += left_out
        return ReadResult(reading, (*warnings, *located.warnings), located.label, place_doubts)

    def _placed(
        self, given: ReaderInput, name: str, said: Identified, located: ReadResult
    ) -> tuple[records.Reading, tuple[str, ...]]:
        """Where the things are, and what is changed and asked; and warnings. Raises `ObjectNotFound`."""
        assert located.reading.grounding is not None, "what was asked for and not seen is an error"
        deviation, label = self._measured.bbox_deviation, located.label
        is_other = bool(label) and set(name_words(label)).isdisjoint(name_words(name))
        update = {"bbox_deviation": deviation, "is_doubtful": is_other}
        mover = located.reading.grounding.model_copy(update=update)
        others, doubles = separate_objects(mover, located.reading.objects)
        changed = {name_words(each): each for change in said.changes for each in (change.object, *change.targets)}
        seen = {name_words(name), *(name_words(each.object) for each in (*others, *given.known))}
        for lost in (each for words, each in changed.items() if words not in seen):
            fault = f"{self._subject} does not see '{lost}' in the image, which the question changes."
            raise ObjectNotFound(fault, remedy=GIVE_PLACE)
        objects = (
            each.model_copy(update={"role": "target"}) if name_words(each.object) in changed else each
            for each in others
        )
        reading = records.Reading(
            grounding=mover,
            objects=tuple(each.model_copy(update={"bbox_deviation": deviation}) for each in objects),
            objects_complete=located.reading.objects_complete and not doubles,
            interventions=tuple(change.as_said for change in said.changes),
            asked=said.asked,
            question_is_doubtful=bool(said.warnings),
            language=said.language,
        )
        mismatch = f"Asked for '{name}', the reader gave a place that it calls '{label}'."
        return reading, (*((mismatch,) if is_other else ()), *doubles)

    def _way(self, read: records.MotionRequest | None) -> dict[str, Any]:
        """Fields of a motion: which way it goes as it was read, and how far off that may be."""
        deviation = self._measured.direction_deviation
        if read is None:
            return {"direction_deviation": deviation}
        way = read.model_dump(include={"direction", "depth", "along_arrow"}, exclude_defaults=True)
        way |= {"cue": read.cue or "orientation", "direction_deviation": deviation}
        return way | ({"depth_deviation": deviation} if read.depth else {})

    def _with_motion(
        self, given: ReaderInput, reading: records.Reading, fields: dict[str, Any]
    ) -> tuple[records.Reading, tuple[str, ...]]:
        """The reading with its motion; what else moves must have a place. Raises `CannotReadDirection`."""
        places = {name_words(each.object) for each in (*given.known, *reading.objects)}
        moving: tuple[records.OtherMotionRequest, ...] = fields.pop("others", ())
        lost = [each.object for each in moving if name_words(each.object) not in places]
        if lost and reading.grounding is not None:  # they were looked for with the mover
            raise CannotReadDirection(f"'{lost[0]}' moves, too, and was not found.", remedy=GIVE_DIRECTION)
        if moving:
            update = {"direction_deviation": self._measured.direction_deviation}
            fields["others"] = tuple(each.model_copy(update=update) for each in moving if each.object not in lost)
        left_out = (f"'{name}' moves, too, and was left out: it has no place. {GIVE_OBJECT}" for name in lost)
        motion = records.MotionRequest.model_validate(fields)
        return reading.model_copy(update={"motion": motion}), tuple(left_out)

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
            pixels = (given.image, *(() if imagined is None else pictures(imagined)))
            jpegs = tuple(encode(each, self._client.family).jpeg for each in pixels)
        calls = answer_calls(given.question, options, jpegs, imagined, votes, self._reasoning)
        results = self._client.complete_all(calls, given)
        readings = tuple(each for each in results if not isinstance(each, CowError))
        if not readings:
            raise next(each for each in results if isinstance(each, CowError))
        return tuple(replace(each, notes=(*each.notes, *given.calls.notes)) for each in readings)

    def _identify(self, given: ReaderInput, image: EncodedImage) -> Identified:
        """The question in words; of several arrows the MLLM says which one is meant."""
        with given.cpu():
            said = identified_by_words(given) if given.words and len(given.seen.arrows) <= 1 else None
        said = said or self._client.complete(identify_call(given, image, self._reasoning), given)
        return said or NOTHING_IDENTIFIED

    def _locate(
        self,
        given: ReaderInput,
        image: EncodedImage,
        said: Identified,
        name: str,
        kind: records.MotionKind,
        bbox: records.BBox | None,
    ) -> tuple[ReadResult, Scale]:
        """Asks for the place, the direction and, of what falls, the scale, as far as they are needed; all at once.

        Raises `ObjectNotFound`, `MllmBadReply`, `MllmUnavailable`.
        """
        others: tuple[str, ...] = ()
        if bbox is None and said.object:
            named = (*said.must_be_found, *given.sought, *said.others)
            others = tuple(dict.fromkeys(each for each in named if name_words(each) != name_words(name)))
        wants_direction = given.motion_wanted and kind in DIRECTED_KINDS
        is_asked_again = bbox is not None and bool(given.objections)  # the direction alone
        calls: dict[str, PromptCall[Any]] = {}
        if bbox is None or wants_direction:
            calls["place"] = locate_call(given, image, name, bbox, others, wants_direction, self._reasoning)
        if given.motion_wanted and kind in FALLING_KINDS and not is_asked_again:
            calls["scale"] = scale_call(image, name, self._reasoning)
        results = dict(zip(calls, self._client.complete_all(list(calls.values()), given), strict=True))
        located: ReadResult | CowError | None = results.get("place", ReadResult())
        scale: Scale | CowError = results.get("scale", UNKNOWN_SCALE)
        if isinstance(located, CowError):
            raise located
        if located is None:
            raise ObjectNotFound(f"{self._subject} does not see '{name}' in the image.", remedy=GIVE_PLACE)
        if isinstance(scale, CowError):
            told = f"The scale of the scene could not be read ({scale.code}): the default one was taken."
            return replace(located, warnings=(told, *located.warnings)), UNKNOWN_SCALE
        return located, scale


def create(settings: Settings) -> MllmReader:
    """Factory for the registry. Raises `ReaderUnavailable` if COW_MLLM cannot be used."""
    return MllmReader("mllm", MllmClient(configure(settings), settings), settings.mllm_base_url or "")
