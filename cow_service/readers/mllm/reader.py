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
from cow_service.readers.base import GIVE_DIRECTION, GIVE_OBJECT, GIVE_PLACE, ReaderInput, ReadResult
from cow_service.readers.chat import ChatTurn
from cow_service.readers.mllm.answer import VOTING_TEMPERATURE, answer_calls
from cow_service.readers.mllm.check import MllmCheck, check_model
from cow_service.readers.mllm.client import MllmClient, PromptCall
from cow_service.readers.mllm.contents import pictures
from cow_service.readers.mllm.coordinates import EncodedImage, encode
from cow_service.readers.mllm.identify import Identified, identified_by_words, identify_call
from cow_service.readers.mllm.known import UNKNOWN, USUAL
from cow_service.readers.mllm.locate import DOWN, Line, Located, Scale, locate_call, scale_call, separate_objects
from cow_service.readers.mllm.models import configure
from cow_service.readers.mllm.replies import name_words
from cow_service.records import DIRECTED_KINDS, FALLING_KINDS
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

    def read(self, given: ReaderInput) -> ReadResult:
        """Two calls: what moves, unless the question's words say it; then where it is and which way it moves.

        Only the second where the place and the kind of motion are known. Raises `ObjectNotFound`, `MllmBadReply`,
        `MllmUnavailable`.
        """
        with given.cpu():
            image = encode(given.scene.image, self._client.family)
        place, motion = given.given.grounding, given.given.motion
        is_placed = place is not None and place.bbox is not None
        is_known = is_placed and motion is not None and motion.kind is not None
        identified = None if is_known else self._identify(given, image)
        name = (place.object if place is not None else None) or (None if identified is None else identified.object)
        if name is None:
            raise ObjectNotFound(
                f"{self._subject} sees nothing in the image that the question could move.", remedy=GIVE_PLACE
            )
        kind = (motion.kind if is_known and motion else identified and identified.kind) or DEFAULT_KIND
        bbox = place.bbox if is_placed and place is not None else None
        located, scale = self._locate(given, image, identified, name, kind, bbox)
        warnings = () if identified is None else identified.warnings
        if bbox is not None:
            reading = records.Reading()
        elif located is None:
            raise ObjectNotFound(f"{self._subject} does not see '{name}' in the image.", remedy=GIVE_PLACE)
        else:
            reading, told = self._placed(given, name, identified, located)
            warnings += told
        if given.motion_wanted:
            said = {} if identified is None else identified.motion
            said |= self._way(located.line) if located is not None and located.line and kind in DIRECTED_KINDS else {}
            said |= {"direction_deviation": self._measured.direction_deviation} if kind in DIRECTED_KINDS else {}
            placed = reading.grounding or place
            said |= self._scaled(scale, placed.bbox if placed is not None else None)
            if isinstance(scale, CowError):
                default = "the default one was taken"
                warnings += (f"The scale of the scene could not be read ({scale.code}): {default}.",)
            reading, left_out = self._with_motion(given, reading, said)
            warnings += left_out
        warnings += () if located is None else located.warnings
        label = "" if located is None else located.label
        return ReadResult(reading, warnings, label, self._family_warnings if bbox is None else ())

    def _placed(
        self, given: ReaderInput, name: str, identified: Identified | None, located: Located
    ) -> tuple[records.Reading, tuple[str, ...]]:
        """Where the things are, and what is changed and asked; and warnings. Raises `ObjectNotFound`."""
        deviation, label = self._measured.bbox_deviation, located.label
        is_other = bool(label) and set(name_words(label)).isdisjoint(name_words(name))
        mover = records.GroundingRequest(
            object=name,
            bbox=located.bbox,
            point=None if located.bbox is not None else located.point,
            bbox_deviation=deviation,
            is_doubtful=is_other,
        )
        others, doubles = separate_objects(mover, located.others)
        changes = () if identified is None else identified.changes
        changed = {each: "target" for change in changes for each in (change.object, *change.targets)}
        seen = {" ".join(name_words(each.object)) for each in (*others, *given.known)} | {" ".join(name_words(name))}
        for each in changed:
            if " ".join(name_words(each)) not in seen:
                raise ObjectNotFound(
                    f"{self._subject} does not see '{each}' in the image, which the question changes.",
                    remedy=GIVE_PLACE,
                )
        meant = [name_words(each) for each in changed]
        reading = records.Reading(
            grounding=mover,
            objects=tuple(
                each.model_copy(
                    update={
                        "bbox_deviation": deviation,
                        "role": "target" if name_words(each.object) in meant else each.role,
                    }
                )
                for each in others
            ),
            objects_complete=located.objects_complete and not doubles,
            interventions=tuple(
                records.InterventionRequest(kind="remove", object=each.object)
                if each.kind == "remove"
                else records.InterventionRequest(
                    kind="place", object=each.object, relation=each.relation, targets=each.targets
                )
                for each in changes
            ),
            asked=None if identified is None else identified.asked,
            question_is_doubtful=bool(identified and identified.warnings),
            language=None if identified is None else identified.language,
        )
        mismatch = f"Asked for '{name}', the reader gave a place that it calls '{located.label}'."
        return reading, (*((mismatch,) if is_other else ()), *doubles)

    def _way(self, line: Line) -> dict[str, Any]:
        """The fields of a motion that tell which way it goes."""
        said: dict[str, Any] = {"cue": line.cue or "orientation", "along_arrow": line.along_arrow}
        if line.camera is not None:
            said["direction"], said["depth"] = depth_motion(CAMERA_SENSE[line.camera])
            said["depth_deviation"] = self._measured.direction_deviation
        elif line.ends is not None:
            (x0, y0), (x1, y1) = line.ends
            said["direction"] = (x1 - x0, y1 - y0)
        return {name: value for name, value in said.items() if value is not None}

    def _scaled(self, scale: Scale | CowError | None, bbox: records.BBox | None) -> dict[str, Any]:
        """The fields of a motion that tell the scale, and which way things fall."""
        if not isinstance(scale, Scale):
            return {}
        metres = None if bbox is None else scale.metres_per_pixel(bbox)
        return {"down": DOWN[scale.down], **({} if metres is None else {"metres_per_pixel": metres})}

    def _with_motion(
        self, given: ReaderInput, reading: records.Reading, said: dict[str, Any]
    ) -> tuple[records.Reading, tuple[str, ...]]:
        """The reading with its motion; what else moves must have a place. Raises `CannotReadDirection`."""
        places = {" ".join(name_words(each.object)) for each in (*given.known, *reading.objects)}
        moving: tuple[records.OtherMotionRequest, ...] = said.pop("others", ())
        lost = [each.object for each in moving if " ".join(name_words(each.object)) not in places]
        if lost and reading.grounding is not None:  # they were looked for with the mover
            raise CannotReadDirection(f"'{lost[0]}' moves, too, and was not found.", remedy=GIVE_DIRECTION)
        deviation = self._measured.direction_deviation
        kept = (each for each in moving if each.object not in lost)
        said |= (
            {"others": tuple(each.model_copy(update={"direction_deviation": deviation}) for each in kept)}
            if moving
            else {}
        )
        left_out = (f"'{name}' moves, too, and was left out: it has no place. {GIVE_OBJECT}" for name in lost)
        motion = records.MotionRequest.model_validate(said)
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
            pixels = (given.scene.image, *(() if imagined is None else pictures(imagined)))
            jpegs = tuple(encode(each, self._client.family).jpeg for each in pixels)
        calls = answer_calls(given.question, options, jpegs, imagined, votes, self._reasoning)
        results = self._client.complete_all(calls, given)
        readings = tuple(each for each in results if not isinstance(each, CowError))
        if not readings:
            raise next(each for each in results if isinstance(each, CowError))
        return tuple(replace(each, notes=(*each.notes, *given.calls.notes)) for each in readings)

    def _identify(self, given: ReaderInput, image: EncodedImage) -> Identified | None:
        """The question in words; of several arrows the MLLM says which one is meant."""
        with given.cpu():
            said = identified_by_words(given) if given.words and len(given.scene.arrows) <= 1 else None
        return said or self._client.complete(identify_call(given, image, self._reasoning), given)

    def _locate(
        self,
        given: ReaderInput,
        image: EncodedImage,
        identified: Identified | None,
        name: str,
        kind: records.MotionKind,
        bbox: records.BBox | None,
    ) -> tuple[Located | None, Scale | CowError | None]:
        """Asks for the place, the direction and, of what falls, the scale, as far as they are needed; all at once.

        None for what was not asked for, or not seen. Raises `MllmBadReply`, `MllmUnavailable`.
        """
        others: tuple[str, ...] = ()
        if identified is not None and bbox is None:
            named = (*identified.must_be_found, *given.sought, *identified.others)
            others = tuple(dict.fromkeys(each for each in named if name_words(each) != name_words(name)))
        wants_direction = given.motion_wanted and kind in DIRECTED_KINDS
        is_asked_again = bbox is not None and bool(given.objections)  # the direction alone
        calls: dict[str, PromptCall[Any]] = {}
        if bbox is None or wants_direction:
            calls["place"] = locate_call(given, image, name, bbox, others, wants_direction, self._reasoning)
        if given.motion_wanted and kind in FALLING_KINDS and not is_asked_again:
            calls["scale"] = scale_call(image, name, self._reasoning)
        results = dict(zip(calls, self._client.complete_all(list(calls.values()), given), strict=True))
        located: Located | CowError | None = results.get("place")
        if isinstance(located, CowError):
            raise located
        return located, results.get("scale")


def create(settings: Settings) -> MllmReader:
    """Factory for the registry. Raises `ReaderUnavailable` if COW_MLLM cannot be used."""
    return MllmReader("mllm", MllmClient(configure(settings), settings), settings.mllm_base_url or "")
