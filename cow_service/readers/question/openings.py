"""Sets aside what opens a sentence and changes nothing: "Excuse me, could you please tell me whether ..."."""

from __future__ import annotations

import re

from cow_service.readers.question import lexicon as lex
from cow_service.readers.question.parsing import read_from
from cow_service.readers.question.phrases import key_at, tokens

_ENDS = frozenset(".?!;")
_WINDOW = 24  # words of the openings of one sentence
_MAX_TRIES = 12  # of one question
_LONGEST_FIRST = sorted(map(re.escape, lex.TABLES["said_as"]), key=len, reverse=True)
_SAID_AS = re.compile(rf"\b(?:{'|'.join(_LONGEST_FIRST)})\b", re.I)
_TAG = re.compile(rf",\s*(?:{'|'.join(lex.SETS['tags'])})\s*\?(?=\s+\S)", re.I)  # and something else is asked


def without_openings(text: str) -> str:
    """The text without openings; what asks by a statement ("I wonder whether it ...") begins with "tell me" then.

    Words of informal English are put as the grammar has them ("gonna" as "going to").
    """
    text = _TAG.sub(".", text)
    text = _SAID_AS.sub(lambda found: lex.TABLES["said_as"][found[0].lower()], text.replace("’", "'"))
    found, kept, end, tries = tokens(text), list[str](), 0, 0
    for at in range(len(found)):
        if not (at == 0 or key_at(found, at - 1) in _ENDS) or tries >= _MAX_TRIES:
            continue
        tries += 1
        parsed = read_from("opening", found, at, _WINDOW)
        if parsed is None:
            continue
        tree, behind = parsed
        asks = next(tree.find_data("asks_if"), None)
        kept += [text[end : found[at].start], "" if asks is None else f"tell me {found[behind - 1].key} "]
        end = found[behind].start if behind < len(found) else len(text)
    return "".join([*kept, text[end:]])
