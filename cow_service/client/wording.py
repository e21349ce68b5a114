"""What a result comes to, in words: encounters, contacts, the outcome, how sure each is, and what was asked for it."""

from __future__ import annotations

from cow_service.records import MEETINGS, BackendInfo, Contact, Encounter, Gate, Outcome, Trajectory, Usage
from cow_service.records.world import BAND_PERCENTILES

MAX_CONTACTS = 6  # that are told


def asked_words(usage: Usage) -> str:
    """What a multimodal LLM was asked."""
    if not usage.calls:
        return "none"
    return f"{usage.calls} calls, {usage.input_tokens} tokens in, {usage.output_tokens} out"


def readiness_words(backend: BackendInfo) -> str:
    """Whether a reader or generator can be used, and what is missing where it cannot."""
    if backend.ready is None:
        return "unknown"
    return "yes" if backend.ready else f"needs {', '.join(backend.missing) or 'its weights'}"


def gate_words(gate: Gate) -> str:
    """What was answered before looking, and what came of it."""
    votes = ", ".join(f"{name} {count}" for name, count in gate.votes.items()) or "no vote"
    return f"{votes} of {gate.asked}; {gate.reason}: {'imagined' if gate.imagined else 'not imagined'}"


def band_words(trajectory: Trajectory) -> str:
    """What the band of an overlay says; empty where it has none."""
    if trajectory.law != "contact" or not trajectory.ensemble:
        return ""
    low, high = BAND_PERCENTILES
    return f"band: where {high - low}% of {trajectory.ensemble} worlds have it, across and down apart"


def worlds(probability: float) -> str:
    """A probability as people read it."""
    return f"{probability:.0%} of the worlds"


def encounter_words(encounter: Encounter, fps: float) -> str:
    """What the mover does with the other object, when, and in how many worlds."""
    sure = "" if encounter.probability is None else f" ({worlds(encounter.probability)})"
    return f"{MEETINGS[encounter.kind]} {encounter.object} at {encounter.first_frame / fps:.1f} s{sure}"


def encounters_words(trajectory: Trajectory) -> str:
    """All that the mover encounters."""
    met = [encounter_words(encounter, trajectory.fps) for encounter in trajectory.encounters]
    return ", ".join(met) or ("meets nothing" if trajectory.encounters_known else "encounters were not computed")


def first_contacts(trajectory: Trajectory) -> tuple[Contact, ...]:
    """Those after the start that are told: a thing that comes to rest touches the floor many times."""
    return tuple(contact for contact in trajectory.contacts if contact.time > 0)[:MAX_CONTACTS]


def contacts_words(trajectory: Trajectory) -> str:
    """Which two begin to touch, and when; empty where none do."""
    return ", ".join(
        f"{body_name(contact.a, trajectory)} and {body_name(contact.b, trajectory)} at {contact.time:.1f} s"
        for contact in first_contacts(trajectory)
    )


def body_name(body: int | None, trajectory: Trajectory) -> str:
    """What the body with that index is called; null is the floor."""
    return "the floor" if body is None else trajectory.bodies[body].object


def outcome_words(outcome: Outcome) -> str:
    """What the question asks, as the world answers it, and how sure that is."""
    parts = [outcome.facts.rstrip(".")] if outcome.facts else []
    value = _value(outcome)
    if value:
        parts.append(value)
    if not outcome.sure:
        parts.append("not sure")
    if outcome.depends_on:
        parts.append(f"it depends on {' and '.join(outcome.depends_on)}")
    elif outcome.robust and outcome.sure:
        parts.append("robust")
    return "; ".join(parts)


def _value(outcome: Outcome) -> str:
    sure = "" if outcome.probability is None else f", {worlds(outcome.probability)}"
    if outcome.asked.form == "which-first":
        return f"first: {outcome.first or 'none'}{sure}"
    if outcome.asked.form == "how-many":
        return "" if outcome.count is None else f"count: {outcome.count}{sure}"
    if outcome.asked.form == "when" and outcome.time is not None:
        band = "" if outcome.time_band is None else f" ({outcome.time_band[0]:.1f} to {outcome.time_band[1]:.1f} s)"
        return f"after {outcome.time:.1f} s{band}{sure}"
    if outcome.probability is None or outcome.asked.form in ("where", "what-happens"):  # the facts are the answer
        return ""
    return f"what is asked happens in {worlds(outcome.probability)}"
