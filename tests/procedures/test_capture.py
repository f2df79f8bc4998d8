"""When a picture of a board counts: the scene stood still, and it is sharp."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from cellctl.calib.targets import Detection
from cellctl.geometry import Array
from cellctl.procedures.capture import CaptureLimits, shift_px

GRID = np.stack(np.meshgrid(np.arange(9) * 40.0, np.arange(6) * 40.0), axis=-1).reshape(-1, 2) + 500

NONE = np.empty((0, 2, 2))


def seen(pixels: Array, ids: Array | None = None) -> Detection:
    ids = np.arange(len(pixels)) if ids is None else ids
    return Detection(ids, pixels, np.column_stack([pixels, np.zeros(len(pixels))]), NONE)


def turned(degrees: float) -> Array:
    middle, angle = GRID.mean(axis=0), np.radians(degrees)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return (GRID - middle) @ turn.T + middle


def test_a_shift_is_its_length():
    assert shift_px(seen(GRID), seen(GRID + (0.3, 0.4))) == pytest.approx(0.5)


def test_a_turn_about_the_board_s_middle_is_seen():
    """The mean displacement of a turn is zero; its corners move most."""
    reach = np.linalg.norm(GRID - GRID.mean(axis=0), axis=1).max()
    expected = reach * 2 * np.sin(np.radians(0.5) / 2)
    assert shift_px(seen(GRID), seen(turned(0.5))) == pytest.approx(expected, rel=1e-6)


def test_noise_of_still_corners_is_no_motion():
    rng = np.random.default_rng(0)
    noisy = [seen(GRID + rng.normal(0.0, 0.04, GRID.shape)) for _ in range(20)]
    shifts = [shift_px(a, b) for a, b in itertools.pairwise(noisy)]
    assert np.median(shifts) < CaptureLimits().shift_px


def test_only_common_points_are_compared():
    ids = np.arange(len(GRID))
    moved = seen((GRID + (0.0, 0.2))[10:], ids[10:])
    assert shift_px(seen(GRID, ids), moved) == pytest.approx(0.2)
    assert shift_px(seen(GRID[:5]), seen(GRID[10:], ids[10:])) == float("inf")
