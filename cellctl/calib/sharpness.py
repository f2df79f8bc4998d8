"""How sharp a picture of a board is."""

from __future__ import annotations

from typing import Any

import numpy as np

from cellctl.calib.corners import grey, sample
from cellctl.calib.projector_map import apply_homography, direct_linear_transform
from cellctl.calib.targets import Detection
from cellctl.geometry import Array

STEPS = 96
LOW, HIGH = 0.1, 0.9
MINIMUM_CONTRAST = 8.0
TOO_BLURRED_PX = 3.0
"""A view whose edges are wider should be taken again: its corners are noisy or smeared."""


def sharpness(image: Any, detection: Detection) -> float:
    """Width in pixels over which the board's printed edges rise from 10 to 90 %: their median.

    As OpenCV's `estimateChessboardSharpness`, for any board, and though half of it be covered. A
    lens in focus gives about 2 px; see TOO_BLURRED_PX. Infinite when no edge can be measured.
    """
    H = direct_linear_transform(detection.points[:, :2], detection.pixels)
    ends = apply_homography(H, detection.profiles)
    picture = grey(image)
    h, w = picture.shape
    inside = ((ends > 1) & (ends < np.array([w, h]) - 2)).all(axis=(1, 2))
    ends = ends[inside]
    along = np.linspace(0.0, 1.0, STEPS)[:, None]
    values = sample(picture, ends[:, :1] * (1.0 - along) + ends[:, 1:] * along)
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    widths = _rise(values) * lengths
    clear = np.isfinite(widths)
    return float(np.median(widths[clear])) if clear.any() else float("inf")


def _rise(values: Array) -> Array:
    """Part of each profile (m, STEPS) between its last value below 10 % and its first above
    90 %; not-a-number without contrast."""
    end = STEPS // 8
    first, last = values[:, :end].mean(axis=1), values[:, -end:].mean(axis=1)
    contrast = last - first
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (values - first[:, None]) / contrast[:, None]
    high = _crossing(share, HIGH)
    low = 1.0 - _crossing(1.0 - share[:, ::-1], 1.0 - LOW)
    clear = (np.abs(contrast) > MINIMUM_CONTRAST) & (high > low)
    return np.where(clear, high - low, np.nan)


def _crossing(share: Array, level: float) -> Array:
    """Where (m,), from 0 to 1, each row first reaches `level`, between its samples."""
    reached = share >= level
    index = np.maximum(np.argmax(reached, axis=1), 1)
    rows = np.arange(len(share))
    before, after = share[rows, index - 1], share[rows, index]
    with np.errstate(divide="ignore", invalid="ignore"):
        part = np.clip((level - before) / (after - before), 0.0, 1.0)
    return np.where(reached.any(axis=1), (index - 1 + part) / (STEPS - 1), np.nan)
