"""What a refusal is in a test: its code and the fields it points to. Its wording stands in api/test_error_table.py."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from cow_service.errors import CowError


@contextmanager
def refused(code: str, *pointers: str) -> Iterator[pytest.ExceptionInfo[CowError]]:
    """The block raises a `CowError` of this code that points to these fields, if any are named."""
    with pytest.raises(CowError) as caught:
        yield caught
    assert caught.value.code == code, caught.value
    if pointers:
        assert tuple(field.pointer for field in caught.value.errors) == pointers, caught.value.errors
