"""The noise floor of every finder, on rendered pictures: by size, blur, noise and tilt.

Bias and deviation per axis in px, against the truth, with pixel centres at integers. The limits
are what was measured, and a third more.
"""

from __future__ import annotations

import numpy as np
import pytest

from cellctl.calib.printed import Unseen
from cellctl.calib.targets import ArucoGrid, Board, Charuco, Chessboard, Dots
from cellctl.geometry import Array, transform_points
from tests.calib.render import homography, picture, truth

SIZE = (1280, 720)
CHESS = Chessboard((9, 6), 0.03)
CHARUCO = Charuco((7, 5), 0.03, 0.021, "DICT_4X4_50")
GRID = ArucoGrid((3, 4), 0.05, 0.06, "DICT_4X4_50")
DOTS = Dots((9, 7), 0.03)
UNIT_M: dict[Board, float] = {CHESS: 0.03, CHARUCO: 0.03, GRID: 0.05, DOTS: 0.03}

SHARP, FLAT, TILTED = 0.7, (0.0, 0.0), (35.0, -25.0)


def errors(board: Board, unit_px: float, tilt=FLAT, blur=SHARP, noise=2.0) -> Array:
    """(n, 2) over two pictures; squares, markers or spacings are `unit_px` wide, untilted."""
    found = []
    for seed in (0, 1):
        H = homography(board, SIZE, 915.0 * UNIT_M[board] / unit_px, tilt, 17.0 + 77.0 * seed)
        seen = board.look(picture(board, H, SIZE, blur=blur, noise=noise, seed=seed))
        assert not isinstance(seen, Unseen), seen
        assert len(seen.ids) == len(board.points)
        off = [
            seen.pixels - truth(transform_points(turn, board.points), H)[seen.ids]
            for turn in board.symmetries
        ]
        found.append(min(off, key=lambda e: float(np.square(e).sum())))
    return np.concatenate(found)


@pytest.mark.parametrize(
    ("board", "unit_px", "limit_px"),
    [
        (CHESS, 10, 0.031),
        (CHESS, 20, 0.016),
        (CHESS, 60, 0.019),
        (CHARUCO, 20, 0.095),
        (CHARUCO, 35, 0.027),
        (CHARUCO, 60, 0.018),
        (GRID, 20, 0.067),
        (GRID, 28, 0.027),
        (GRID, 45, 0.023),
        (GRID, 80, 0.017),
        (DOTS, 14, 0.018),
        (DOTS, 35, 0.010),
    ],
)
def test_the_floor_by_size(board, unit_px, limit_px):
    off = errors(board, unit_px)
    assert off.std() < limit_px
    assert np.abs(off.mean(axis=0)).max() < 0.012


@pytest.mark.parametrize(
    ("board", "unit_px", "tilt", "blur", "noise", "limit_px"),
    [
        (CHESS, 35, TILTED, SHARP, 2.0, 0.023),
        (CHARUCO, 35, TILTED, SHARP, 2.0, 0.032),
        (GRID, 45, TILTED, SHARP, 2.0, 0.027),
        (DOTS, 35, TILTED, SHARP, 2.0, 0.011),
        (CHESS, 35, FLAT, 1.5, 2.0, 0.023),
        (CHARUCO, 35, FLAT, 1.5, 2.0, 0.047),
        (GRID, 45, FLAT, 1.5, 2.0, 0.055),
        (DOTS, 35, FLAT, 1.5, 2.0, 0.014),
        (CHESS, 35, FLAT, SHARP, 6.0, 0.043),
        (CHARUCO, 35, FLAT, SHARP, 6.0, 0.063),
        (GRID, 45, FLAT, SHARP, 6.0, 0.068),
        (DOTS, 35, FLAT, SHARP, 6.0, 0.018),
    ],
)
def test_the_floor_when_tilted_blurred_and_noisy(board, unit_px, tilt, blur, noise, limit_px):
    off = errors(board, unit_px, tilt, blur, noise)
    assert off.std() < limit_px
    assert np.abs(off.mean(axis=0)).max() < 0.02


@pytest.mark.parametrize(("board", "unit_px"), [(GRID, 14), (DOTS, 10)])
def test_what_is_too_small_is_not_seen_rather_than_wrong(board, unit_px):
    """Markers of two pixels a module, dots of five pixels: corners would be off by pixels."""
    for seed in (0, 1):
        H = homography(board, SIZE, 915.0 * UNIT_M[board] / unit_px, (20.0, -10.0), 77.0 * seed)
        seen = board.look(picture(board, H, SIZE, seed=seed))
        if not isinstance(seen, Unseen):
            assert np.abs(seen.pixels - truth(board.points, H)[seen.ids]).max() < 0.5
