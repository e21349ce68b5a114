"""Narrations in every language: the templates are complete, and a request says which language it wants."""

from __future__ import annotations

import json
import re
from string import Formatter
from typing import Any, get_args

import httpx
import pytest
from conftest import EXAMPLES
from drawn import floor
from hypothesis import given
from hypothesis import strategies as st
from outcomes import CHOICES, outcome, simulated
from runs import run_of
from servers import data_url
from test_facts import THROWN, body, grounded, path, touch, world

from cow_service.api.submission import language_of
from cow_service.narration.summary import narrate
from cow_service.narration.words import TEMPLATES, phrases_of
from cow_service.readers.mllm.identify import read_identified
from cow_service.records import (
    Asked,
    AskedForm,
    AskedRelation,
    Doubt,
    Language,
    Outcome,
    PlacementResult,
    PlaceRelation,
)
from cow_service.stages.keys import StageResult

LANGUAGES: tuple[Language, ...] = get_args(Language)
OTHERS = [each for each in LANGUAGES if each != "en"]
ENGLISH = phrases_of("en").templates
# Words of English templates that would show that one was left untranslated.
UNTRANSLATED = re.compile(r"\b(the|hits|after|simulated|because|which)\b")
READ = {"en": "Yes", "de": "Ja", "es": "Sí", "fr": "Oui", "zh": "是", "ja": "はい"}


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


@pytest.mark.parametrize("language", LANGUAGES)
def test_every_outcome_is_told_in_every_language(language: Language) -> None:
    said = set[str]()
    for decided, _, _ in CHOICES:
        simulation = simulated(decided)
        narration = narrate(simulation.grounding, simulation.trajectory, language)
        assert narration.language == language
        text = f"{narration.summary} {narration.story}"
        assert not re.search(r"[{}]|None|  ", text)
        said.add(narration.answer)
    assert READ[language] in said


def _outcome(asked: Asked, rest: dict[str, Any]) -> Outcome:
    return Outcome(asked=asked, subject=asked.subject, robust=False, **rest)


OUTCOMES = st.builds(
    _outcome,
    st.builds(
        Asked,
        form=st.sampled_from(get_args(AskedForm)),
        relation=st.sampled_from(get_args(AskedRelation)),
        negated=st.booleans(),
        target=st.sampled_from([None, "white cube"]),
        among=st.sampled_from([(), ("white cube", "mug")]),
        every=st.booleans(),
        partly=st.booleans(),
        within=st.sampled_from([None, 1.0]),
        subject=st.sampled_from([None, "mug"]),
    ),
    st.fixed_dictionaries({
        "object": st.sampled_from([None, "white cube"]),
        "probability": st.sampled_from([None, 0.0, 0.3, 0.5, 1.0]),
        "sure": st.booleans(),
        "first": st.sampled_from([None, "mug"]),
        "count": st.sampled_from([None, 0, 1, 3]),
        "time": st.sampled_from([None, 0.8, 4.0]),
        "time_band": st.sampled_from([None, (0.5, 1.0)]),
        "depends_on": st.sampled_from([(), ("speed",), ("faint", "speed"), ("depth",)]),
    }),
)  # fmt: skip


@given(
    OUTCOMES, st.sampled_from(LANGUAGES), st.sampled_from(["floor", "air", "white cube"]), st.sampled_from([0, 1, 50])
)
def test_any_outcome_has_words(outcome: Outcome, language: Language, support: str, ensemble: int) -> None:
    bodies = (body("ball", "sphere", support), body("white cube"), body("mug"))
    told = world(bodies=bodies, paths=(path(), path(1)), encounters=(touch(),), ensemble=ensemble, outcome=outcome)
    narration = narrate(grounded("ball"), told, language)
    assert narration.summary
    assert not re.search(r"[{}]|None|  ", f"{narration.summary} {narration.story}")
    assert (narration.answer == phrases_of(language).templates["not-sure"]) == (not outcome.sure)


@pytest.mark.parametrize(
    ("language", "story"),
    [
        ("en", "The ball bounces once, rolls on and hits the white cube after about 1.1 s."),
        ("de", "„ball“ springt einmal auf, rollt weiter und trifft nach etwa 1,1 s „white cube“."),
        ("es", "«ball» rebota una vez, sigue rodando y choca con «white cube» tras unos 1,1 s."),
        ("fr", "« ball » rebondit une fois, continue de rouler et heurte « white cube » au bout d'environ 1,1 s."),
        ("zh", "“ball”弹起一次，继续滚动，约 1.1 秒后碰到“white cube”。"),
        ("ja", "「ball」は1回弾みます。転がり続けます。約1.1秒後に「white cube」に当たります。"),
    ],
)  # fmt: skip
def test_a_story_reads_as_its_language_does(language: Language, story: str) -> None:
    assert narrate(grounded("ball"), THROWN, language).story.replace("\u00a0", " ") == story


@pytest.mark.parametrize(
    ("language", "one_is_missed", "neither_falls", "unsure"),
    [
        ("en", "it misses the mug or it misses the vase",
         "the mug is not knocked over and the vase is not knocked over",
         "Probably not: in 40 of 50 simulated versions it misses the mug; it depends most on how fast it moves."),
        ("de", "„{}“ verfehlt „mug“ oder „{}“ verfehlt „vase“",
         "„mug“ wird nicht umgestoßen und „vase“ wird nicht umgestoßen",
         "Wahrscheinlich nicht – „{}“ verfehlt „mug“, und zwar in 40 von 50 simulierten Versionen; am meisten hängt es "
         "davon ab, wie schnell die Bewegung ist."),
        ("es", "«{}» no toca «mug» o «{}» no toca «vase»", "«mug» no vuelca y «vase» no vuelca",
         "Probablemente no: en 40 de 50 versiones simuladas, «{}» no toca «mug»; depende sobre todo de la "
         "velocidad del movimiento."),
        ("fr", "« {} » ne touche pas « mug » ou « {} » ne touche pas « vase »",
         "« mug » ne se renverse pas et « vase » ne se renverse pas",
         "Probablement pas : dans 40 versions simulées sur 50, « {} » ne touche pas « mug » ; cela dépend surtout de "
         "la vitesse du mouvement."),
        ("zh", "“{}”不会碰到“mug”，或者“{}”不会碰到“vase”", "“mug”不会被撞倒，“vase”不会被撞倒",
         "很可能不会：在 50 个模拟版本中的 40 个里，“{}”不会碰到“mug”；主要取决于它运动得多快。"),
        ("ja", "「{}」は「mug」には当たりません、または「{}」は「vase」には当たりません",
         "「mug」は倒されませんし、「vase」は倒されません",
         "おそらく違います：「{}」は「mug」には当たりません（50通りのシミュレーションのうち40通り）。"
         "主に動く速さによって変わります。"),
    ],
)  # fmt: skip
def test_a_summary_reads_as_its_language_does(
    language: Language, one_is_missed: str, neither_falls: str, unsure: str
) -> None:
    def summary(asked: Asked, probability: float, **values: Any) -> str:
        simulation = simulated(outcome(asked, probability, **values))
        mover = simulation.grounding.object
        told = narrate(simulation.grounding, simulation.trajectory, language).summary
        return told.replace("\u00a0", " ").replace(mover, "{}")

    touches = Asked(relation="touches", among=("mug", "vase"), every=True)
    assert one_is_missed in summary(touches, 0.02), "not to hit both is not to miss both"
    assert neither_falls in summary(Asked(relation="tips", among=("mug", "vase")), 0.02)
    hit = Asked(relation="touches", target="mug")
    assert summary(hit, 0.2, sure=False, depends_on=("speed",)) == unsure


@pytest.mark.parametrize(
    ("header", "language"),
    [
        ("de-CH,de;q=0.9,en;q=0.8", "de"),
        ("en-US,en;q=0.9,fr;q=0.8", None),
        ("pt-BR, fr;q=0.5, ja;q=0.7", "ja"),
        ("ZH-hant", "zh"),
        ("*", None),
        ("", None),
        ("de;q=0, es;q=nonsense, fr;q=0.1", "fr"),
        ("de; q=0.3 , fr; q=0.9", "fr"),
        ("fry, den;q=0.9", None),
        ("fr;q=0.5, de;q=inf, ja;q=9", "fr"),
    ],
)
def test_a_header_names_the_language(header: str, language: Language | None) -> None:
    assert language_of(header) == language


@given(st.text())
def test_any_header_is_read(header: str) -> None:
    assert language_of(header) in (None, *OTHERS)


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


@pytest.mark.parametrize(("said", "language"), [("de", "de"), ("zh-Hans", "zh"), ("Klingon", None), (None, None)])
def test_a_multimodal_llm_says_which_language_the_question_has(said: str | None, language: Language | None) -> None:
    found = read_identified(json.dumps({"object": "ball", "kind": "linear", "language": said}))
    assert found is not None
    assert found.language == language


def test_the_questions_language_counts_where_the_request_names_none() -> None:
    read = grounded("ball").model_copy(update={"language": "es"})
    run = run_of(floor(), question="?")
    run.results["grounding"] = StageResult(value=read)
    assert run.language == "es"
    asked = run_of(floor(), question="?", language="en")
    asked.results["grounding"] = StageResult(value=read)
    assert asked.language == "en"
