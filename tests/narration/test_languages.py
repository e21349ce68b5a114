"""Narrations in every language: the templates are complete, and a request says which language it wants."""

from __future__ import annotations

import json
import re
from string import Formatter
from typing import Any, get_args

import httpx
import pytest
from conftest import EXAMPLES
from hypothesis import given
from hypothesis import strategies as st
from servers import data_url
from told import BODIES, asks, body, grounded, path, touch, unsure, world

from cow_service.api.submission import language_of
from cow_service.narration.summary import narrate
from cow_service.narration.words import TEMPLATES, phrases_of
from cow_service.records import (
    Asked,
    AskedForm,
    AskedRelation,
    CandidateOutcome,
    Doubt,
    Language,
    Outcome,
    PlacementResult,
    PlaceRelation,
)

LANGUAGES: tuple[Language, ...] = get_args(Language)
OTHERS = [each for each in LANGUAGES if each != "en"]
ENGLISH = phrases_of("en").templates
# Words of English templates that would show that one was left untranslated.
UNTRANSLATED = re.compile(r"\b(the|hits|after|simulated|because|which)\b")


def values_of(template: str) -> set[str]:
    return {name for _, name, _, _ in Formatter().parse(template) if name}


def test_there_is_a_file_for_every_language_of_a_request() -> None:
    assert set(TEMPLATES.names()) == set(LANGUAGES)


@pytest.mark.parametrize("language", OTHERS)
def test_a_language_has_every_template_with_the_same_values(language: Language) -> None:
    templates = phrases_of(language).templates
    assert templates.keys() == ENGLISH.keys()
    differing = {key for key, text in templates.items() if values_of(text) != values_of(ENGLISH[key])}
    assert differing == {"subject"}, "English alone says `it` of what the question has named"
    assert not [key for key, text in templates.items() if UNTRANSLATED.search(text)]


@pytest.mark.parametrize("language", LANGUAGES)
def test_every_word_of_the_records_has_a_template(language: Language) -> None:
    templates = phrases_of(language).templates
    wanted = {f"doubt-{each}" for each in get_args(Doubt)} | {f"at-{each}" for each in get_args(PlaceRelation)}
    wanted |= {f"end-{each}" for each in get_args(PlacementResult)}
    assert wanted <= templates.keys()


CANDIDATES = tuple(
    CandidateOutcome(object=name, probability=share, sure=True) for name, share in (("cube", 0.9), ("mug", 0.1))
)
OUTCOMES = st.builds(
    lambda question, rest: Outcome(asked=question, subject=question.subject, robust=False, **rest),
    st.builds(
        Asked,
        form=st.sampled_from(get_args(AskedForm)),
        relation=st.sampled_from(get_args(AskedRelation)),
        negated=st.booleans(),
        target=st.sampled_from([None, "cube"]),
        among=st.sampled_from([(), ("cube", "mug")]),
        every=st.booleans(),
        partly=st.booleans(),
        within=st.sampled_from([None, 1.0]),
        subject=st.sampled_from([None, "mug"]),
    ),
    st.fixed_dictionaries({
        "object": st.sampled_from([None, "cube"]),
        "probability": st.sampled_from([None, 0.0, 0.3, 0.5, 1.0]),
        "sure": st.booleans(),
        "first": st.sampled_from([None, "mug"]),
        "candidates": st.sampled_from([(), CANDIDATES[:1], CANDIDATES[1:], CANDIDATES]),
        "as_it_is": st.sampled_from([None, 0.1, 0.9]),
        "count": st.sampled_from([None, 0, 1, 3]),
        "time": st.sampled_from([None, 0.8, 4.0]),
        "time_band": st.sampled_from([None, (0.5, 1.0)]),
        "depends_on": st.sampled_from([(), ("speed",), ("faint", "speed"), ("depth",)]),
    }),
)  # fmt: skip


@given(OUTCOMES, st.sampled_from(LANGUAGES), st.sampled_from(["floor", "air", "cube"]), st.sampled_from([0, 1, 50]))
def test_any_record_has_words(decided: Outcome, language: Language, support: str, ensemble: int) -> None:
    given = {"bodies": (body("ball", support), *BODIES[1:]), "paths": (path(), path(1)), "encounters": (touch(),)}
    told = world(decided, ensemble=ensemble, **given)
    narration = narrate(grounded(), told, language)
    assert narration.language == language
    assert narration.summary
    assert not re.search(r"[{}]|None|  ", f"{narration.summary} {narration.story}")
    assert (narration.answer == phrases_of(language).templates["not-sure"]) == (not decided.sure)


# Of each language: a story; that one of two is missed, that neither falls; and why an answer is not sure.
SENTENCES: dict[Language, tuple[str, str, str, str]] = {
    "de": (
        "„ball“ rollt nach rechts und trifft nach etwa 1,1 s „cube“.",
        "Nein, „ball“ verfehlt „mug“ oder „ball“ verfehlt „vase“.",
        "Nein, „mug“ wird nicht umgestoßen und „vase“ wird nicht umgestoßen.",
        "Wahrscheinlich nicht – „ball“ verfehlt „mug“, und zwar in 40 von 50 simulierten Versionen; am meisten hängt "
        "es davon ab, wie schnell die Bewegung ist.",
    ),
    "es": (
        "«ball» rueda hacia la derecha y choca con «cube» tras unos 1,1 s.",
        "No, «ball» no toca «mug» o «ball» no toca «vase».",
        "No, «mug» no vuelca y «vase» no vuelca.",
        "Probablemente no: en 40 de 50 versiones simuladas, «ball» no toca «mug»; depende sobre todo de la velocidad "
        "del movimiento.",
    ),
    "fr": (
        "« ball » roule vers la droite et heurte « cube » au bout d'environ 1,1 s.",
        "Non, « ball » ne touche pas « mug » ou « ball » ne touche pas « vase ».",
        "Non, « mug » ne se renverse pas et « vase » ne se renverse pas.",
        "Probablement pas : dans 40 versions simulées sur 50, « ball » ne touche pas « mug » ; cela dépend surtout de "
        "la vitesse du mouvement.",
    ),
    "zh": (
        "“ball”向右滚动，约 1.1 秒后碰到“cube”。",
        "否，“ball”不会碰到“mug”，或者“ball”不会碰到“vase”。",
        "否，“mug”不会被撞倒，“vase”不会被撞倒。",
        "很可能不会：在 50 个模拟版本中的 40 个里，“ball”不会碰到“mug”；主要取决于它运动得多快。",
    ),
    "ja": (
        "「ball」は右へ転がります。約1.1秒後に「cube」に当たります。",
        "いいえ、「ball」は「mug」には当たりません、または「ball」は「vase」には当たりません。",
        "いいえ、「mug」は倒されませんし、「vase」は倒されません。",
        "おそらく違います：「ball」は「mug」には当たりません（50通りのシミュレーションのうち40通り）。"
        "主に動く速さによって変わります。",
    ),
}  # fmt: skip


@pytest.mark.parametrize("language", SENTENCES)
def test_sentences_read_as_their_language_does(language: Language) -> None:
    missed = asks("touches", None, 0.02, among=("mug", "vase"), every=True)
    doubted = unsure("touches", "mug", 0.2, depends_on=("speed",))
    said = [narrate(grounded(), world(encounters=(touch(),)), language).story]
    for decided in (missed, asks("tips", None, 0.02, among=("mug", "vase")), doubted):
        told = narrate(grounded(), world(decided, ensemble=50), language)
        said.append(told.summary.removesuffix(told.agreement).strip())
    assert tuple(each.replace("\u00a0", " ") for each in said) == SENTENCES[language]


HEADERS: dict[str, Language | None] = {
    "de-CH,de;q=0.9,en;q=0.8": "de",
    "en-US,en;q=0.9,fr;q=0.8": None,
    "pt-BR, fr;q=0.5, ja;q=0.7": "ja",
    "*": None,
    "de;q=0, es;q=nonsense, fr;q=0.1": "fr",
    "fry, den;q=0.9": None,
    "fr;q=0.5, de;q=inf, ja;q=9": "fr",
}


def test_a_header_names_the_language() -> None:
    assert {header: language_of(header) for header in HEADERS} == HEADERS


def test_a_server_answers_in_the_language_of_the_field_else_of_the_header(http: httpx.Client) -> None:
    image = data_url((EXAMPLES / "ball-and-mug" / "image.jpg").read_bytes()).replace("png", "jpeg", 1)
    question = "If the yellow ball moves opposite to the direction of the arrow, will it hit the blue mug?"
    body = {"image": image, "question": question}

    def answered(headers: dict[str, str], **fields: Any) -> Any:
        reply = http.post("/answer", json=body | fields, headers=headers)
        assert reply.status_code == 200, reply.text
        return reply.json()

    german = answered({"Accept-Language": "de"})
    assert german["answer"] == "Ja"
    assert german["reasoning"].startswith("Ja, „yellow ball“ trifft nach etwa 0,8\u00a0s „blue mug“. ")
    assert german["simulation"]["narration"]["language"] == "de"
    assert german["reasoning"] == german["simulation"]["narration"]["summary"]
    french = answered({"Accept-Language": "de"}, language="fr")
    assert french["answer"] == "Oui"
    assert set(french["reused"]) >= {"grounding", "motion", "trajectory", "generation"}, "nothing is simulated again"
    assert answered({"Accept-Language": "en-GB"})["answer"] == "Yes"
    again = {"Idempotency-Key": "language-1"}
    first = answered(again | {"Accept-Language": "de"})
    assert answered(again | {"Accept-Language": "fr"}) == first, "a header of preferences makes no other request"
    options = {"language": "de", "options": ["Nein", "Ja", "Nicht sicher"]}
    assert answered({}, **options)["answer"] == "B"
    assert answered({}, **options | {"question": "If the yellow ball moves, is it happy?"})["answer"] == "C"


@pytest.mark.slow  # the packages that speak to LLMs take seconds to import
def test_a_multimodal_llm_says_which_language_the_question_has() -> None:
    from cow_service.readers.mllm.identify import read_identified

    for said, language in (("zh-Hans", "zh"), ("Klingon", None), (None, None)):
        found = read_identified(json.dumps({"object": "ball", "kind": "linear", "language": said}))
        assert found is not None
        assert found.language == language
