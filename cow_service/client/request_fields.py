"""What calls take, as the fields of a request: `law` is that of the motion, masks are pictures of any form."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from typing import Any

from cow_service.client.inputs import Upload, image_input
from cow_service.client.serialization import plain
from cow_service.errors import FieldError, InvalidRequest


def request_fields(options: Mapping[str, Any]) -> dict[str, Any]:
    """The fields; those that are None are left out.

    Raises `InvalidRequest` for two different laws, and what `image_input` raises for a mask.
    """
    fields = {name: value for name, value in options.items() if value is not None}
    if "law" in fields:
        fields["motion"] = _with_law(fields.get("motion"), fields.pop("law"))
    if "grounding" in fields:
        fields["grounding"] = _with_mask(fields["grounding"])
    if "objects" in fields:
        fields["objects"] = [_with_mask(given) for given in fields["objects"]]
    return fields


def _with_law(motion: Any, law: Any) -> dict[str, Any]:
    given: dict[str, Any] = {} if motion is None else dict(plain(motion))
    if given.get("law", law) != law:
        detail = f"is {given['law']!r}, and `law` is {law!r}: give one of them"
        raise InvalidRequest(f"`motion.law` {detail}.", errors=(FieldError("/motion/law", detail),))
    return {**given, "law": law}


def _with_mask(place: Any) -> Any:
    """The place with its mask as JSON has it; unchanged where it has none."""
    mask = place.get("mask") if isinstance(place, Mapping) else getattr(place, "mask", None)
    if mask is None:
        return place
    if getattr(getattr(mask, "dtype", None), "kind", "") == "b":
        mask = mask.astype("uint8") * 255
    sent = image_input(mask)
    json = f"data:image/png;base64,{base64.b64encode(sent.data).decode()}" if isinstance(sent, Upload) else sent.json
    return {**plain(place), "mask": json}
