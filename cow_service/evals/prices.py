"""Reads what tokens cost."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml
from pydantic import TypeAdapter, ValidationError

from cow_service.errors import InvalidRequest
from cow_service.evals.report.summary import Price

_TABLE: TypeAdapter[dict[str, Price]] = TypeAdapter(dict[str, Price])


def read_prices(path: Path) -> dict[str, Price]:
    """The prices of models, by their names. Raises `InvalidRequest` for a file that is none."""
    try:
        told: Any = yaml.safe_load(path.read_bytes())
        return _TABLE.validate_python(told)
    except OSError as error:
        raise InvalidRequest(f"The prices '{path}' cannot be read: {error.strerror or error}.") from error
    except (yaml.YAMLError, ValidationError) as error:
        raise InvalidRequest(
            f"'{path}' holds no prices: it must be like {{openai/gpt-5: {{input: 1.25, output: 10}}}}, per million "
            f"tokens. {str(error).splitlines()[0]}"
        ) from error
