"""Figures, times and durations, as a report prints them."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from cellctl.report.odd import number

NONE = "\N{EN DASH}"
MINUS = "\N{MINUS SIGN}"


def figure(value: Any) -> str:
    """Three significant digits, as of a measurement: 0.214, 3.62, 23.7, 915."""
    found = number(value)
    if found is None:
        return NONE
    size = abs(found)
    if size and not 5e-4 <= size < 1e6:
        return f"{found:.2e}".replace("-", MINUS)
    digits = 0 if size >= 100 else 1 if size >= 10 else 2 if size >= 1 else 3
    return f"{found:.{digits}f}".replace("-", MINUS)


def scaled(value: Any, factor: float) -> float | None:
    """A figure in another unit."""
    found = number(value)
    return None if found is None else number(found * factor)


def interval(value: Any) -> str:
    """A pair of numbers as `0.18 to 0.25`; empty when it is none."""
    if not isinstance(value, list) or len(value) != 2 or None in map(number, value):
        return ""
    return f"{figure(value[0])} to {figure(value[1])}"


def moment(value: Any) -> datetime | None:
    """An ISO 8601 time, in UTC."""
    if not isinstance(value, str):
        return None
    try:
        found = datetime.fromisoformat(value)
        return (found if found.tzinfo else found.replace(tzinfo=UTC)).astimezone(UTC)
    except (ValueError, OverflowError):
        return None


def date(value: Any) -> str:
    """As `31 January 2026, 06:15 UTC`."""
    found = moment(value)
    return NONE if found is None else f"{found.day} {found:%B %Y, %H:%M} UTC"


def duration(seconds: float | None) -> str:
    """As `12.4 s`, `3 min 07 s`, `1 h 12 min`."""
    if seconds is None or seconds < 0:
        return NONE
    if seconds < 99.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def plural(number_of: int, name: str) -> str:
    """As `1 view`, `12 views`."""
    return f"{number_of} {name}" if number_of == 1 else f"{number_of} {name}s"
