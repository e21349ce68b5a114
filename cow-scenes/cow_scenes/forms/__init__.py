"""The forms of question, by name."""

from .base import Draft, Form
from .billiards import BILLIARDS
from .fly import TABLE, THROW, TRAIL
from .occlude import OCCLUDE
from .put import FALL, PLACE
from .slide import CAR, FIRST, REMOVE, SLIDE

FORM_OF: dict[str, Form] = {
    "slide": SLIDE,
    "first": FIRST,
    "car": CAR,
    "remove": REMOVE,
    "throw": THROW,
    "table": TABLE,
    "trail": TRAIL,
    "billiards": BILLIARDS,
    "fall": FALL,
    "place": PLACE,
    "slide-occlude": OCCLUDE,
}

__all__ = ["FORM_OF", "Draft", "Form"]
