"""What may be anything, taken as what it should be. A report is also made of files that somebody
edited, that another version wrote, or that a crash left behind; nothing here raises."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from cellctl.errors import printable
from cellctl.geometry import Array

LONGEST = 2000
LARGEST = 1e12
"""What is larger is no measurement, and would overflow where it is drawn."""


def number(value: Any) -> float | None:
    """A finite number that could have been measured, or None."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    if not -LARGEST < value < LARGEST or math.isnan(value):
        return None
    return float(value)


def count(value: Any) -> int | None:
    """How many there are of a list or an object, or a whole number that says so."""
    if isinstance(value, list | dict):
        return len(value)
    found = number(value)
    return int(found) if found is not None and found >= 0 else None


def at(value: Any, *path: str) -> Any:
    """What lies in nested objects under the names of `path`; None where there is nothing."""
    for name in path:
        value = value.get(name) if isinstance(value, dict) else None
    return value


def mapping(value: Any, *path: str) -> dict[str, Any]:
    """As `at`, an object; an empty one when it is none."""
    found = at(value, *path)
    return found if isinstance(found, dict) else {}


def rows(value: Any, *path: str) -> list[dict[str, Any]]:
    """As `at`, the objects of a list."""
    found = at(value, *path)
    return [row for row in found if isinstance(row, dict)] if isinstance(found, list) else []


def text(value: Any) -> str:
    """For a person: strings as they are, other things as JSON; what is very long is cut."""
    if value is None:
        return ""
    if not isinstance(value, str):
        value = pretty(value, indent=None)
    value = "".join(c if c.isprintable() or c in "\n\t" else "\ufffd" for c in printable(value))
    return value if len(value) <= LONGEST else f"{value[:LONGEST]} ..."


def texts(value: Any) -> list[str]:
    """The sentences of a list; a string is one sentence."""
    if isinstance(value, str):
        return [text(value)] if value else []
    return [text(item) for item in value] if isinstance(value, list | tuple) else []


def numbers(value: Any, length: int) -> list[float] | None:
    """`length` finite numbers, or None."""
    if not isinstance(value, list | tuple) or len(value) != length:
        return None
    found = [number(item) for item in value]
    return None if None in found else [item for item in found if item is not None]


def points(values: Any, width: int) -> Array:
    """(n, width) of a list of lists; rows that are not `width` finite numbers are left out."""
    items: Iterable[Any] = values if isinstance(values, list) else ()
    found = [row for row in (numbers(item, width) for item in items) if row is not None]
    return np.array(found, dtype=float).reshape(-1, width)


def pretty(value: Any, indent: int | None = 2) -> str:
    """JSON to be read."""
    try:
        return json.dumps(value, indent=indent, ensure_ascii=False, default=str)
    except (ValueError, RecursionError):
        return "(nested too deeply to be shown)"
