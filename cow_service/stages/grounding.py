"""Stage 1: which object moves and where it is, where the others are that matter, and what is asked of them."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import NamedTuple

from cow_service import errors, records
from cow_service.errors import CannotGround, FieldError, InvalidRequest, field_of
from cow_service.media.images import encode_png
from cow_service.media.masks import is_among, is_same_object
from cow_service.narration.story import OF_ITSELF, OF_TARGET
from cow_service.narration.words import same_name
from cow_service.perception.observation import Observation
from cow_service.readers.base import GIVE_OBJECT, ReadResult, WordReader, WordsReading
from cow_service.readers.options import plain
from cow_service.records import Grounding, Intervention, LocatedObject, MotionRequest, ObjectRequest, Reading
from cow_service.requests import SimulateRequest
from cow_service.stages.keys import StageResult
from cow_service.stages.places import Located, bare, find_things, locate_given, outlined
from cow_service.stages.run import Run
from cow_service.stages.settling import SeenThings, box_of, mover_of, settle_mover, settle_places, settle_question

FLOOR = frozenset({"floor", "the floor", "ground", "the ground"})


def ground(run: Run[SimulateRequest]) -> StageResult[Grounding]:
    """The mover, from the request where it says so, else from the reader; its mask [H, W] is stored as PNG.

    The others are those of the request, then those of the reader that are not among them, without what is taken away.
    Raises `InvalidRequest` and `CannotGround` for what the request says of places and for interventions that cannot be
    made, and what the reader raises.
    """
    with run.cpu():
        observation = run.sight.look(run.words.trail_named)
        given, own = locate_given(run, observation)
    if own is None:
        reading, warnings = read_scene(run, observation, given)
        with run.cpu():
            mover, others, doubts = (outlined if run.can_segment else bare)(run, observation, reading)
    else:
        reading, warnings = said_in_words(run), ()
        mover, others, doubts = own, (), ()
    apart = [each for each in given if not each.is_same_as(mover)]
    others = (*apart, *(each for each in others if not is_among(each.bbox, [known.bbox for known in apart])))
    with run.cpu():
        placed = [each.stored(run) for each in others]
        observation, mask = cut_out(run, mover.stored(run), placed, reading)
    grounding = settle_grounding(run, reading, mover, placed, mask)
    notes = (
        *(warning for each in (mover, *given) for warning in each.warnings),
        *(
            f"`objects.{index}` ('{each.name}') lies where the moving object is, and was taken for it."
            for index, each in enumerate(given)
            if each not in apart and not same_name(each.name, mover.name)
        ),
        *drawings_removed(observation, run.words),
        *unanswerable(grounding, run),
    )
    things = (*others_of(grounding), *removed_of(grounding))
    artifacts = (mask.sha256, *(each.mask.sha256 for each in things if each.mask is not None))
    return StageResult(
        value=grounding, warnings=(*warnings, *doubts, *notes), artifacts=artifacts, motion=reading.motion
    )


# --- what is read


def said_in_words(run: Run[SimulateRequest]) -> Reading:
    """What the words say beside where things are, for a mover that the request gives."""
    said = run.words.reading
    return said.model_copy(update={"grounding": None, "objects": (), "motion": None})


def read_scene(
    run: Run[SimulateRequest], observation: Observation, given: Sequence[Located]
) -> tuple[Reading, tuple[str, ...]]:
    """What the reader says of places and of what is asked, settled with the words and with what is seen; and warnings.

    A reader that may be wrong is asked once more with what speaks against its reading, and not to rely on the words
    where that is what they say; a reply that cannot be used then leaves the first. Raises what the reader raises.
    """
    known = [each.said for each in given if isinstance(each.said, ObjectRequest)]
    find = partial(find_things, run, observation) if "detector" in run.backends.perception.names else None
    asking = replace(run.reader_input("grounding", observation, known), find=find, words=run.words)
    settled = _settled(run, observation, run.reader.read(asking), known)
    if settled.objections:
        again = replace(asking, objections=settled.objections, words=None if settled.is_misread else run.words)
        with suppress(CannotGround, errors.CannotReadDirection, errors.MllmBadReply, errors.MllmUnavailable):
            settled = _settled(run, observation, run.reader.read(again), known)
    return settled.reading, (*settled.warnings, *settled.objections)


class Settled(NamedTuple):
    """A reading, with warnings, and with what speaks against it."""

    reading: Reading
    warnings: tuple[str, ...] = ()
    objections: tuple[str, ...] = ()
    is_misread: bool = False  # that is what the words say of what moves or is asked


def _settled(
    run: Run[SimulateRequest], observation: Observation, read: ReadResult, known: Sequence[ObjectRequest]
) -> Settled:
    """The reading without what the request says, with its boxes, what is asked and what is changed settled."""
    words, said, request = run.backends.words(), run.words, run.request
    with run.cpu():
        reading = located(observation, read.reading, run.reader.source)
    if not run.reader.heeds_objections:
        return Settled(reading, read.warnings)
    if request.interventions is not None:
        said = replace(said, reading=said.reading.model_copy(update={"interventions": None}))
        reading = reading.model_copy(update={"interventions": None})
    others = [each for each in reading.objects if not any(same_name(each.object, one.object) for one in known)]
    if request.objects_complete:
        others = [each for each in others if each.role == "target"]
    reading = reading.model_copy(update={"objects": tuple(others)})
    with run.cpu():
        boxes = [box_of(each) for each in (mover_of(reading), *others)]
        is_bare = frozenset(bbox for bbox in boxes if not observation.shows_thing(bbox))
        reading, objections, is_seen = settle_places(reading, SeenThings(observation.things, is_bare))
    unproved = () if is_seen else read.place_doubts
    if unproved:
        mover = mover_of(reading).model_copy(update={"is_doubtful": True})
        reading = reading.model_copy(update={"grounding": mover})
    reading, misnamed = settle_mover(reading, said, words, read.label)
    reading, misread = settle_question(reading, said, words, is_given=request.asked is not None)
    return Settled(reading, (*read.warnings, *unproved), (*objections, *misnamed, *misread), bool(misnamed or misread))


def located(observation: Observation, reading: Reading, source: records.Source) -> Reading:
    """The reading with its source, and the box of what is at the point of a mover that was only pointed at."""
    mover = mover_of(reading)
    boxed = {} if mover.bbox is not None or mover.point is None else {"bbox": observation.mask_at(mover.point).bbox}
    objects = tuple(each.model_copy(update={"source": source}) for each in reading.objects)
    own = mover.model_copy(update={"source": source, **boxed})
    return reading.model_copy(update={"grounding": own, "objects": objects})


# --- what stage 1 comes to


def cut_out(
    run: Run[SimulateRequest], mover: LocatedObject, others: Sequence[LocatedObject], reading: Reading
) -> tuple[Observation, records.Artifact]:
    """What the image shows once it is known what moves, and the mask of that, stored. To be called with `cpu` held."""
    shows_trail = run.words.trail_named or (reading.motion is not None and reading.motion.cue == "trail")
    observation = run.observe(mover, others, shows_trail)
    if mover.mask is not None:
        return observation, mover.mask
    mask = observation.mask_in(mover.bbox).full()
    return observation, run.backends.artifacts.put(encode_png(mask), "image/png")


def look_again(run: Run[SimulateRequest], grounding: Grounding, cue: records.Cue | None = None) -> Observation:
    """What the image shows as a grounding, and the cue of its motion, have it. To be called with `cpu` held."""
    changed = (thing for each in grounding.interventions for thing in (each.object, *each.targets))
    return run.observe(grounding, (*grounding.others, *changed), grounding.trail_named or cue == "trail")


def settle_grounding(
    run: Run[SimulateRequest], reading: Reading, mover: Located, others: Sequence[LocatedObject], mask: records.Artifact
) -> Grounding:
    """The grounding, with its interventions made, its names understood, and where its mover goes, if it is put."""
    request, said = run.request, mover.said
    own = LocatedObject(object=mover.name, bbox=mover.bbox, prior=said.prior, source=said.source)
    interventions = find_interventions(request, reading, (*others, own))
    removed = [each.object.bbox for each in interventions if each.kind == "remove"]
    x0, y0, x1, y1 = mover.bbox
    pointed = None if said.source == "request" else said.point
    grounding = Grounding(
        object=mover.name,
        point=pointed or ((x0 + x1) / 2, (y0 + y1) / 2),
        bbox=mover.bbox,
        mask=mask,
        others=tuple(other for other in others if not is_among(other.bbox, removed)),
        objects_complete=request.objects_complete or reading.objects_complete,
        interventions=interventions,
        prior=said.prior,
        asked=request.asked or reading.asked,
        question_is_doubtful=request.question_is_doubtful or reading.question_is_doubtful,
        trail_named=run.words.trail_named,
        bbox_deviation=said.bbox_deviation or 0.0,
        is_doubtful=said.is_doubtful,
        language=reading.language,
        source=said.source,
    )
    return put_into_first(understood(grounding, run.backends.words()), request, reading.motion)


def drawings_removed(observation: Observation, words: WordsReading) -> list[str]:
    """A warning where the image has drawings over it of which the question does not speak."""
    drawn = [("an arrow", each.tail) for each in observation.arrows if "arrow" not in words.drawings_named]
    drawn += [("a box", each.bbox[:2]) for each in observation.boxes if "box" not in words.drawings_named]
    places = ", ".join(f"{name} at ({x:.0f}, {y:.0f})" for name, (x, y) in drawn)
    told = (
        f"Taken for annotations drawn over the image, although the question mentions none: {places}. "
        "They are removed from the frames; `generator_options.clean_cues: false` keeps them."
    )
    return [told] if drawn else []


def unanswerable(grounding: Grounding, run: Run[SimulateRequest]) -> list[str]:
    """Warnings where what is asked has no outcome, or none that is sure, as the request has it."""
    warnings, asked, request = list[str](), grounding.asked, run.request
    places = (*([] if request.grounding is None else [request.grounding]), *request.objects)
    doubted = [f"'{each.object or grounding.object}'" for each in places if each.is_doubtful]
    doubted += ["the question"] if request.question_is_doubtful else []
    if doubted:
        warnings.append(f"As the request says, {' and '.join(doubted)} may have been misread, so no answer is sure.")
    if name := asked_of_itself(grounding):
        warnings.append(
            f"Something cannot hit itself, so the question about '{name}' has no answer: ask about another object."
        )
    if request.asked is not None or grounding.source != "embedded":  # which warns of what it does not find
        things = (*others_of(grounding), *removed_of(grounding))
        known = [grounding.object, *(each.object for each in things)]
        named = () if asked is None else (asked.subject, asked.target, *asked.among)
        warnings += [
            f"'{name}' is asked about and was not found in the image, so there is no outcome: give it in `objects` "
            "under this name."
            for name in named
            if name is not None and not any(same_name(name, each) for each in known)
        ]
    return warnings


# --- interventions


def find_interventions(
    request: SimulateRequest, reading: Reading, things: Sequence[LocatedObject]
) -> tuple[Intervention, ...]:
    """Those of the request, an empty list included, else those of the question; the last of `things` is the mover.

    Raises `InvalidRequest` for an object that is not there, for what is done twice, for a thing that is put to itself,
    and for the mover taken away; `CannotGround` where the question says so.
    """
    found, is_given = list[Intervention](), request.interventions is not None
    for index, change in enumerate((request.interventions if is_given else reading.interventions) or ()):
        pointer = f"/interventions/{index}" if is_given else None
        gone = [other.object for other in found if other.kind == "remove"]  # of two with one name, each goes once
        each = with_things(change, (*(thing for thing in things if thing not in gone), *gone), pointer)
        fault = fault_of_removal(each, found, things[-1]) if each.kind == "remove" else fault_of_placing(each, found)
        if fault is not None and pointer is None:
            raise CannotGround(f"{fault} Ask about another object, or state the change in `interventions`.")
        if fault is not None and pointer is not None:
            raise InvalidRequest(f"`{field_of(pointer)}`: {fault}", errors=(FieldError(pointer, fault),))
        found.append(each)
    return tuple(found)


def fault_of_removal(each: Intervention, before: Sequence[Intervention], mover: LocatedObject) -> str | None:
    """Why a thing cannot be taken away, after some changes `before`."""
    name, box = each.object.object, each.object.bbox
    if is_same_object(box, mover.bbox):
        return f"'{name}' is what moves: it cannot be taken away."
    if is_among(box, [other.object.bbox for other in before if other.kind == "remove"]):
        return f"'{name}' is taken away twice: name each object once."
    placed = (thing for other in before if other.kind == "place" for thing in (other.object, *other.targets))
    is_used = is_among(box, [thing.bbox for thing in placed])
    return f"'{name}' takes part in another change: it cannot be taken away." if is_used else None


def fault_of_placing(each: Intervention, before: Sequence[Intervention]) -> str | None:
    """Why a thing cannot be put somewhere, after some changes `before`."""
    name, box = each.object.object, each.object.bbox
    if is_among(box, [thing.bbox for thing in each.targets]):
        return f"'{name}' cannot be put {(each.relation or 'to').replace('-', ' ')} itself."
    if is_among(box, [other.object.bbox for other in before if other.kind == "place"]):
        return f"'{name}' is put somewhere twice: name each object once."
    removed = [other.object.bbox for other in before if other.kind == "remove"]
    gone = [thing.object for thing in (each.object, *each.targets) if is_among(thing.bbox, removed)]
    return f"'{gone[0]}' is taken away: nothing can be put there, nor it elsewhere." if gone else None


def with_things(
    change: records.InterventionRequest, things: Sequence[LocatedObject], pointer: str | None = None
) -> Intervention:
    """A change with its objects in the place of their names, of the request at a JSON Pointer or of the question.

    Raises `InvalidRequest` for a name that none of the things has.
    """

    def thing_at(field: str, name: str) -> LocatedObject:
        if thing := next((thing for thing in things if same_name(thing.object, name)), None):
            return thing
        at, detail = "/objects", f"the question changes '{name}', which is not looked for when `grounding` is given"
        if pointer is not None:
            known = ", ".join(f"'{each.object}'" for each in things)
            at, detail = f"{pointer}/{field}", f"there is no '{name}' among the objects of the scene, which are {known}"
        raise InvalidRequest(f"`{field_of(at)}`: {detail}.", remedy=GIVE_OBJECT, errors=(FieldError(at, detail),))

    targets = tuple(thing_at(f"targets/{at}", name) for at, name in enumerate(change.targets))
    thing = thing_at("object", change.object)
    return Intervention(kind=change.kind, object=thing, relation=change.relation, targets=targets)


# --- what a grounding says of its things


def placed_mover(grounding: Grounding) -> Intervention | None:
    """The intervention that puts the grounded object somewhere; None where it stays or moves by itself."""
    placed = (each for each in grounding.interventions if each.kind == "place")
    return next((each for each in placed if is_same_object(each.object.bbox, grounding.bbox)), None)


def put_into_first(grounding: Grounding, request: SimulateRequest, read: MotionRequest | None) -> Grounding:
    """With the mover put into the first of several things, if it is asked into which of them it fits and nothing says
    how it moves."""
    asked, mover = grounding.asked, LocatedObject(object=grounding.object, bbox=grounding.bbox, source=grounding.source)
    if asked is None or (asked.form, asked.relation, asked.subject) != ("which", "inside", None):
        return grounding
    given, kind = request.motion, None if read is None else read.kind
    if grounding.source == "request" and request.trajectory is None:
        kind = "place" if given is None or not given.is_whole else given.stated_kind
    first = [each for each in others_of(grounding) if asked.among and same_name(each.object, asked.among[0])]
    if kind != "place" or not first or placed_mover(grounding) is not None:
        return grounding
    put = Intervention(kind="place", object=mover, relation="into", targets=tuple(first[:1]))
    return grounding.model_copy(update={"interventions": (*grounding.interventions, put)})


def asked_of_itself(grounding: Grounding) -> str | None:
    """The thing of which it is asked whether it meets, hides or holds itself: none can."""
    asked = grounding.asked
    if asked is None or asked.target is None or asked.relation in (*OF_TARGET, *OF_ITSELF):
        return None
    return asked.target if same_name(asked.target, asked.subject or grounding.object) else None


def others_of(grounding: Grounding) -> tuple[LocatedObject, ...]:
    """The other objects of a grounding, what is put somewhere and what it is put to among them."""
    found, mover = list(grounding.others), grounding.bbox
    for each in grounding.interventions:
        moved = [each.object] if each.kind == "place" and not is_same_object(each.object.bbox, mover) else []
        boxes = [thing.bbox for thing in found]
        found += [thing for thing in (*moved, *each.targets) if not is_among(thing.bbox, boxes)]
    return tuple(found)


def removed_of(grounding: Grounding) -> tuple[LocatedObject, ...]:
    """What is taken away."""
    return tuple(each.object for each in grounding.interventions if each.kind == "remove")


def understood(grounding: Grounding, words: WordReader) -> Grounding:
    """The grounding with what the names of its things say of their shapes, and with the things that a kind means."""

    def prior_of(thing: LocatedObject | Grounding) -> records.ObjectPrior | None:
        """Its prior, completed by what its name says; None where neither says anything."""
        said = {field: value for field, value in thing.prior or () if value}
        completed = words.read_name(thing.object).model_copy(update=said)
        return None if completed == records.ObjectPrior() else completed

    def described(thing: LocatedObject) -> LocatedObject:
        return thing.model_copy(update={"prior": prior_of(thing)})

    asked = grounding.asked
    if asked is not None and asked.among:
        apart = {plain(grounding.object), plain(asked.subject or "")}
        names = [other.object for other in others_of(grounding) if plain(other.object) not in apart]
        # Of what is met first the floor is what is left, where no thing is met.
        things = [said for said in asked.among if asked.form != "which-first" or plain(said) not in FLOOR]
        among = dict.fromkeys(name for said in things for name in words.names_meant(said, names))
        asked = asked.model_copy(update={"among": tuple(among)})
    interventions = (
        each.model_copy(update={"object": described(each.object), "targets": tuple(map(described, each.targets))})
        for each in grounding.interventions
    )
    return grounding.model_copy(
        update={
            "others": tuple(map(described, grounding.others)),
            "interventions": tuple(interventions),
            "prior": prior_of(grounding),
            "asked": asked,
        }
    )
