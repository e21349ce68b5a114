"""Numbers of a reply with their units: how fast, how far and how long something moves.

They are read as leniently as they are written. What cannot be read is left out with a warning; nothing here fails.
"""

import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Annotated, Any, cast

from pydantic import PlainValidator, ValidationError, ValidationInfo, WithJsonSchema

from cow_service import records
from cow_service.readers.mllm.coordinates import HUGE, NUMBER
from cow_service.readers.mllm.replies import is_none, is_number, nullable, text_of

_UNITS = {
    "": ("", 1.0), "px": ("px", 1.0), "pixel": ("px", 1.0), "m": ("m", 1.0), "metre": ("m", 1.0), "meter": ("m", 1.0),
    "cm": ("m", 0.01), "centimetre": ("m", 0.01), "centimeter": ("m", 0.01), "mm": ("m", 0.001), "inch": ("m", 0.0254),
    "km": ("m", 1000.0), "s": ("s", 1.0), "sec": ("s", 1.0), "second": ("s", 1.0), "ms": ("s", 0.001),
    "minute": ("s", 60.0), "min": ("s", 60.0),
}  # fmt: skip
_MEASURED = re.compile(
    rf"(?P<number>{NUMBER})\s*(?P<unit>[a-z]*)(?P<rate>\s*(?:/|per)\s*s(?:ec|econd)?)?", re.IGNORECASE
)
_TEXT = WithJsonSchema(nullable({"type": "string"}))


@dataclass
class ReadingContext:
    """Where validators put warnings and faults."""

    warnings: list[str] = field(default_factory=list[str])
    faults: list[str] = field(default_factory=list[str])  # parts that are asked for again once, then left out

    @property
    def left_out(self) -> tuple[str, ...]:
        """Warnings of all that is left out."""
        again = "The reader was asked again for a part of its reply, which then was left out"
        return (*self.warnings, *(f"{again}: {fault}." for fault in self.faults))


def context_of(info: ValidationInfo) -> ReadingContext:
    """The context with which a reply is read."""
    return cast("ReadingContext", info.context)


def _optional(expected: str, read: Callable[[object], object]) -> tuple[Any, Any]:
    """The annotations of an optional field."""

    def validated(written: object, info: ValidationInfo) -> object:
        is_open = is_none(written) or text_of(written).lower() == "unknown"
        value = None if is_open else read(written)
        if value is None and not is_open:
            shown = " ".join(str(written).split())[:40]
            warning = f"The reader's `{info.field_name}` was left out: '{shown}' is not {expected}."
            context_of(info).warnings.append(warning)
        return value

    return PlainValidator(validated), _TEXT


def measured(written: object) -> tuple[float, str] | None:
    """A number and its unit: px, m, s, px/s, m/s, or nothing where none is given."""
    if is_number(written):
        return (float(written), "") if abs(written) < HUGE else None  # NaN is not less than anything
    found = _MEASURED.fullmatch(text_of(written).strip(" ."))
    named = "" if found is None else found["unit"].lower()
    unit = _UNITS.get(named) or _UNITS.get(named.removesuffix("s"))
    if found is None or unit is None:
        return None
    return float(found["number"]) * unit[1], unit[0] + ("/s" if found["rate"] else "")


def positive(written: object, unit: str) -> float | None:
    """A number above 0 in that unit, or without one. None for what is none."""
    found = measured(written)
    return found[0] if found is not None and found[1] in ("", unit) and found[0] > 0 else None


def _quantity(kind: type[records.Speed] | type[records.Distance], *units: str) -> tuple[Any, Any]:
    def read(written: object) -> records.Speed | records.Distance | None:
        found = measured(written)
        if found is None or found[1] not in units or not found[0] > 0:
            return None
        with suppress(ValidationError):  # a number that is too large
            return kind.model_validate({"value": found[0], "unit": found[1]})
        return None

    return _optional(f"a number with {' or '.join(units)}", read)


def _seconds(written: object) -> float | None:
    value = positive(written, "s")
    return value if value is not None and value <= records.MAX_SECONDS else None


Distance = Annotated[records.Distance | None, *_quantity(records.Distance, "px", "m")]
Speed = Annotated[records.Speed | None, *_quantity(records.Speed, "px/s", "m/s")]
Seconds = Annotated[float | None, *_optional(f"a time of up to {records.MAX_SECONDS} s", _seconds)]
