"""When a calibration becomes the active one without a person's word."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def by_hand(_new: Mapping[str, Any], _active: Mapping[str, Any] | None) -> bool:
    """Never."""
    return False


def not_worse(new: Mapping[str, Any], active: Mapping[str, Any] | None) -> bool:
    """Whether the calibration file `new` may replace the file `active` (None: there is none).

    It has passed, and its error on circles that no fit has seen was measured and is no larger
    than what the active one's may be, with the confidence of its interval. An active one whose
    error was never measured is replaced.
    """
    error = _quality(new).get("held_out_mm")
    if new.get("verdict") != "pass" or not isinstance(error, float):
        return False
    if active is None:
        return True
    interval = _quality(active).get("held_out_ci_mm")
    if not isinstance(interval, list):
        return True
    return bool(error <= interval[1])


def _quality(document: Mapping[str, Any]) -> Mapping[str, Any]:
    calibration = document.get("calibration") or {}
    quality: Mapping[str, Any] = calibration.get("quality") or {}
    return quality
