"""The answer of a simulation in words: what the question asks, how many simulated versions agree, and the story."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from cow_service.narration.story import EVENTS, KINDS, OF_COVERING, OF_TARGET, Story
from cow_service.narration.words import Phrases, capitalised, phrases_of
from cow_service.records.results import Narration

if TYPE_CHECKING:
    from cow_service.records import Doubt, Grounding, Language, Outcome, Trajectory

ROUNDING = 1e-6  # of a count of versions, which is rounded down: one that was misread counts half
LEANING = 2 / 3  # share of the simulated versions from which an answer that is not sure is called probable
_UNSEEN: tuple[Doubt, ...] = ("reading", "identity", "outline", "faint")  # doubts that no simulation weighs
_FITTING = ("inside", "on-top", "beside")  # results of a thing that ends as it was meant to
_OF_EACH = ("which", "which-to-remove")  # forms whose answer is what is so of each candidate
_TOLD_BY_STORY = ("where", "what-happens")  # forms whose answer is the story


def narrate(grounding: Grounding, trajectory: Trajectory, language: Language) -> Narration:
    """A trajectory in words of a language."""
    say = phrases_of(language)
    summary = _Summary(grounding.object, trajectory, say)
    story = summary.story.text()
    if trajectory.factual is not None:
        as_it_is = Story(grounding.object, trajectory.factual, say).text()
        label = label_of_changes(grounding, trajectory, say)
        told = ((label, story), (capitalised(say("as-it-is")), as_it_is))
        story = say.templates["between"].join(say("labelled", label=label, story=text) for label, text in told)
    outcome, agreement = trajectory.outcome, summary.agreement()
    if outcome is None:
        answer, said = "", story
    elif not outcome.sure:
        answer, said, agreement = say("not-sure"), summary.unsure(), ""
    elif outcome.asked.form in _TOLD_BY_STORY:
        answer, said = story, story
    else:
        answer, said = direct(outcome, say), summary.sentence()
    return Narration(
        language=language,
        answer=answer,
        summary=say.templates["between"].join(filter(None, (said, agreement))),
        agreement=agreement,
        share=summary.share() if trajectory.ensemble and (outcome is None or outcome.probability is not None) else None,
        story=story,
    )


def direct(outcome: Outcome, say: Phrases) -> str:
    """The answer to an open question, in as few words as there are for it; empty where only the story tells."""
    match outcome.asked.form:
        case "whether" | "changes":
            return say("yes" if outcome.happens else "no")
        case "which-first":
            return outcome.first or say("nothing")
        case "when":
            is_known = outcome.time is not None and outcome.happens
            return say("after", time=say.seconds(outcome.time or 0.0)) if is_known else say("never")
        case "which" | "which-to-remove":
            return chosen_names(outcome, say)
        case "how-many":
            return str(outcome.count or 0)
        case "where" | "what-happens":
            return ""


def chosen_names(outcome: Outcome, say: Phrases) -> str:
    """The candidates of which it is so, in a list."""
    meant = [] if outcome.is_needless else [each.object for each in outcome.candidates if each.is_meant]
    if meant:
        return say.joined(meant, "names-and" if outcome.asked.form == "which" else "names-or")
    is_open = outcome.asked.form == "which" and not outcome.asked.among
    return say("nothing" if outcome.is_needless or is_open else "none-of-them")


def why_unsure(outcome: Outcome, trajectory: Trajectory, say: Phrases) -> str:
    """Why the simulation cannot tell at all, in a sentence; empty where it gives an answer, sure or not."""
    if outcome.asked.target is not None and outcome.object is None:
        return say("unsure-not-found")
    if "depth" in outcome.depends_on:
        return say("unsure-depth")
    if outcome.probability is None or (outcome.asked.form == "how-many" and outcome.count is None):
        untold = "unsure-no-outcome" if trajectory.encounters_known else "unsure-unseen"
        return say(untold if trajectory.ensemble else "unsure-uncounted")
    doubt = None if outcome.sure else next((doubt for doubt in _UNSEEN if doubt in outcome.depends_on), None)
    return "" if doubt is None else say(f"unsure-{doubt}")


def found_in(mover: str, trajectory: Trajectory, say: Phrases) -> str:
    """What most versions say to the question, else how many agree with the story, in a sentence; empty without any."""
    summary, outcome = _Summary(mover, trajectory, say), trajectory.outcome
    if outcome is None or outcome.probability is None or not trajectory.ensemble:
        return summary.agreement()
    return capitalised(say("stated", statement=summary.counted()))


def label_of_changes(grounding: Grounding, trajectory: Trajectory, say: Phrases) -> str:
    """What is changed before the motion, as in: With the vase on the box; empty where nothing is."""
    put = {each.object for each in trajectory.placed}
    removed = [each.object.object for each in grounding.interventions if each.kind == "remove"]
    placed = [each for each in grounding.interventions if each.kind == "place" and each.object.object in put]
    without = say.names(removed) if removed else ""
    states = [
        say(
            f"at-{each.relation or 'into'}",
            object=say.name(each.object.object),
            target=say.names([target.object for target in each.targets]),
        )
        for each in placed
    ]
    having = say.joined(states, "states-and") if states else ""
    if without and having:
        return say("with-without", placed=having, removed=without)
    return say("without", object=without) if without else say("with", object=having) if having else ""


class _Summary:
    """The sentences about the outcome of one trajectory."""

    def __init__(self, mover: str, trajectory: Trajectory, say: Phrases) -> None:
        self._mover, self._trajectory, self._say = mover, trajectory, say
        self._outcome = trajectory.outcome
        self.story = Story(mover, trajectory, say)

    def sentence(self) -> str:
        """The answer as a sentence, as in: Yes, it hits the blue mug after about 0.8 s."""
        outcome, say = self._given, self._say
        form, time = outcome.asked.form, outcome.time
        if form in ("whether", "changes"):
            return say("answered", answer=direct(outcome, say), statement=self._statement(with_time=True))
        said = self._statement(with_time=False)
        if form == "which-first" and outcome.first is not None:
            name = say.name(outcome.first)
            said = name if time is None else say("first-at", object=name, time=say.seconds(time))
        elif form == "how-many" and outcome.count:
            said = self._count(outcome.count)
        elif form == "when" and outcome.happens and time is not None:
            early, late = (say.seconds(each) for each in outcome.time_band or (time, time))
            spread = {"early": early, "late": late} if early != late else {}
            said = say("after-band" if spread else "after", time=say.seconds(time), **spread)
        return capitalised(say("stated", statement=said))

    def unsure(self) -> str:
        """Why there is no answer, in a sentence, as in: Probably not: it misses the mug in 41 of 50 versions."""
        outcome, say, share = self._given, self._say, self.share()
        why = why_unsure(outcome, self._trajectory, say)
        if why or share is None:
            return why
        leaning = share >= LEANING
        key = "probably-not" if leaning and outcome.asked.form == "whether" and not outcome.happens else "probably"
        depends = say("depends", doubt=say(f"doubt-{outcome.depends_on[0]}")) if outcome.depends_on else ""
        answer, statement = say(key if leaning else "not-sure"), self.counted()
        return say("unsure", answer=answer, statement=statement, depends=depends)

    def agreement(self) -> str:
        """How many simulated versions agree with what is said, in a sentence; empty where none were counted."""
        share, total = self.share(), self._trajectory.ensemble
        if share is None or not total:
            return ""
        key = "agree-all" if share == 1 and total > 1 else "agree"
        return self._say(key, count=str(math.floor(share * total + ROUNDING)), total=str(total))

    def counted(self) -> str:
        """What most versions say, and how many of them, as a clause. There must be an outcome with a probability."""
        total, statement = self._trajectory.ensemble, self._statement(with_time=False)
        count = str(math.floor((self.share() or 0.0) * total + ROUNDING))
        return self._say("in-versions", statement=statement, count=count, total=str(total))

    @property
    def _given(self) -> Outcome:
        assert self._outcome is not None  # nothing is asked otherwise
        return self._outcome

    def share(self) -> float | None:
        """The share of the versions that agree with the answer or, if there is none to the question, with the story."""
        outcome = self._outcome
        if outcome is None or outcome.probability is None:
            return self.story.agreement()
        is_yes = outcome.asked.form not in ("whether", "when", "changes") or outcome.happens
        return outcome.probability if is_yes else 1 - outcome.probability

    def _count(self, count: int) -> str:
        return self._say("count-one") if count == 1 else self._say("count-many", count=str(count))

    def _statement(self, *, with_time: bool) -> str:
        """What is so in most versions, as a clause with its subject: it hits the blue mug."""
        outcome, say, form = self._given, self._say, self._given.asked.form
        if form == "changes":
            return say("differs" if outcome.happens else "differs-not")
        if form in _OF_EACH:
            return self._of_each()
        if outcome.first is not None:
            return say("first-is", thing=say.name(outcome.first))
        if form == "how-many" and outcome.count:
            return say("it-is", thing=self._count(outcome.count))
        does = form in ("whether", "when") and outcome.happens != outcome.asked.negated
        return self._event(does, outcome.time if does and with_time else None)

    def _of_each(self) -> str:
        """Of which candidates it is so, and of which of those that the question names it is not."""
        outcome, say, asked = self._given, self._say, self._given.asked
        meant = [each.object for each in outcome.candidates if each.is_meant]
        others = [each.object for each in outcome.candidates if not each.is_meant] if asked.among or not meant else []
        if asked.form == "which-to-remove":
            return self._removals({"prevents": meant, "prevents-not": others})
        if not meant and not asked.among and not asked.negated:
            return self._event(False, None)
        key = "fit" if asked.relation == "inside" else EVENTS[asked.relation]
        told = [(does, names) for does, names in ((not asked.negated, meant), (asked.negated, others)) if names]
        if asked.relation in OF_TARGET:
            statements = [
                say("statement", subject=say.name(name), clause=self._clause(key, does, None, [name]))
                for does, names in told
                for name in names
            ]
            return say.joined(statements, "every-and")
        clauses = [self._clause(key, does, None, names) for does, names in told]
        return say("statement", subject=self._subject, clause=say.joined(clauses, "clauses-and"))

    @property
    def _subject(self) -> str:
        """What does what is asked about, as the subject of a clause."""
        subject = self._given.subject
        return self._say("subject", name=self._say.name(self._mover)) if subject is None else self._say.name(subject)

    def _removals(self, told: dict[str, list[str]]) -> str:
        """What is so in the world that is shown, and by which removals it would not be."""
        outcome, say = self._given, self._say
        shown = self._trajectory.model_copy(update={"outcome": outcome.of_shown})
        there = _Summary(self._mover, shown, say)._statement(with_time=False)
        if outcome.is_needless:
            return say("nothing-to-remove", statement=there)
        removals = [say(key, object=say.names(names, "names-or")) for key, names in told.items() if names]
        return say.joined([there, *removals], "every-and")

    def _event(self, does: bool, time: float | None) -> str:
        """That what is asked about happens, or does not, with its time where one is given."""
        outcome, say, asked = self._given, self._say, self._given.asked
        key = EVENTS[asked.relation] if time is None or asked.relation == "inside" else f"{EVENTS[asked.relation]}-at"
        meant = [outcome.object] if outcome.object is not None else list(asked.among)
        if asked.relation in OF_TARGET:
            if not meant:
                return self._within(say(f"{EVENTS[asked.relation]}-{'any' if does else 'none'}"))
            subjects, parts = [say.name(each) for each in meant], [meant]
        else:
            # Not to hit each one is to miss one of them: it misses this one or it misses that one.
            is_split = asked.every and not does and meant
            subjects, parts = [self._subject], [[each] for each in meant] if is_split else [meant]
        statements = [
            say("statement", subject=subject, clause=self._clause(key, does, time, part))
            for subject in subjects
            for part in parts
        ]
        return say.joined(statements, "every-and" if asked.every == does else "either-or")

    def _clause(self, key: str, does: bool, time: float | None, meant: Sequence[str]) -> str:
        """What its subject does, or does not."""
        say, asked = self._say, self._given.asked
        placement = None if self._given.subject else self._trajectory.placement  # that of the mover
        if key == EVENTS["inside"] and placement is not None and (placement.result in _FITTING) == does:
            return self._within(self.story.placed())
        if asked.relation == "lands" and self.story.support():
            key, meant = key.replace("land", "fall-off"), self.story.support()
        last = "names-and" if asked.every or asked.form == "which" else "names-or"
        if not does:
            key = self._denied(key, meant)
            last = {"fit-not": "names-or"}.get(key, "names-nor")
        elif asked.partly and asked.relation in OF_COVERING:
            key = f"{EVENTS[asked.relation]}-part"
        name = say.names(meant, last) if meant else say("something")
        if time is None or not key.endswith("-at"):
            return self._within(say(key.removesuffix("-at"), object=name))
        return self.story.timed(key, time, object=name)  # which says that it is within the time asked

    def _denied(self, key: str, meant: Sequence[str]) -> str:
        """The template of what does not happen."""
        relation = self._given.asked.relation
        if relation == "touches" and meant and meant == self.story.support():
            return "on-from-start"
        return f"{key}-not" if meant or relation not in KINDS else f"{key}-none"

    def _within(self, clause: str) -> str:
        within = self._given.asked.within
        return clause if within is None else self._say("within", clause=clause, time=self._say.seconds(within))
