"""Finding a checkerboard: a fast look first, a robust one where a board plausibly is.

Corners are numbered from the inner corner whose outer square is dark, along the first axis of
`inner_corners` first, right-handed as seen from the front. Finders begin at either end; colours
tell the ends apart unless both counts are odd or both even.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from cellctl.calib.beyond import print_goes_on
from cellctl.calib.corners import (
    Grey,
    cross,
    enlarged,
    grid_axes,
    grid_spacing,
    reduced,
    refine_crossings,
    saddle_strength,
    sample,
)
from cellctl.calib.printed import Unseen
from cellctl.calib.projector_map import apply_homography, direct_linear_transform
from cellctl.geometry import Array

LONGEST_PX = 960
SADDLE_SIGMA, SADDLE_STRENGTH = 1.5, 4.0
"""A crossing of 30 grey levels of contrast, blurred by a pixel, is that strong."""
ALTERNATING = 0.8
"""Part of the squares that must be darker or brighter than their neighbours, as they should."""
STRAY = 0.4
"""How far corners may be from a plane's picture, in distances between neighbours."""
MOVED_PX, MOVED = 2.5, 0.05
"""How far refinement may move a corner: pixels of the reduced picture, and of the spacing."""
GOES_ON = "the chessboard goes on beyond {}x{} inner corners: count the board's inner corners"


def find_chessboard(image: Grey, inner_corners: tuple[int, int]) -> Array | Unseen:
    """Corners (n, 2) in pixels, row by row, or why the whole board is not in sight."""
    why = Unseen()
    for finder in (_quick, _thorough):
        rough = finder(image, inner_corners)
        if rough is None:
            continue
        grid = _oriented(image, rough)
        pixels = None if grid is None else _refined(image, grid)
        if grid is None or pixels is None:
            continue
        if not print_goes_on(image, pixels.reshape(grid.shape), alternating=True):
            return pixels
        why = Unseen(GOES_ON.format(*inner_corners))
    return why


def _quick(image: Grey, inner_corners: tuple[int, int]) -> Array | None:
    """Corners (rows, columns, 2) by OpenCV's classic finder: some milliseconds, sharp boards."""
    small, scale = reduced(image, LONGEST_PX, 0.7)
    found, corners = cv2.findChessboardCorners(small, inner_corners, flags=0)
    return _grid(corners, inner_corners, scale) if found else None


def _thorough(image: Grey, inner_corners: tuple[int, int]) -> Array | None:
    """Corners (rows, columns, 2) by the sector-based finder (Duda and Frese, 2018), which takes
    its time, if there are crossings enough in sight."""
    small, scale = reduced(image, LONGEST_PX, 0.0)
    if not _plausible(small, inner_corners):
        return None
    found, corners = cv2.findChessboardCornersSB(small, inner_corners)
    return _grid(corners, inner_corners, scale) if found else None


def _grid(corners: Any, inner_corners: tuple[int, int], scale: float) -> Array:
    columns, rows = inner_corners
    return enlarged(np.asarray(corners, dtype=float).reshape(rows, columns, 2), scale)


def _plausible(image: Grey, inner_corners: tuple[int, int]) -> bool:
    """Whether there are as many crossings in the picture as the board has."""
    strength = saddle_strength(image, SADDLE_SIGMA)
    peaks = (strength > SADDLE_STRENGTH) & (strength >= cv2.dilate(strength, np.ones((5, 5))))
    return int(np.count_nonzero(peaks)) >= 0.8 * inner_corners[0] * inner_corners[1]


def _oriented(image: Grey, grid: Array) -> Array | None:
    """The grid (rows, columns, 2) begun at the right corner, or None when its squares do not
    alternate or it does not lie on a plane."""
    if cross(*_axes(grid)) < 0:
        grid = grid[:, ::-1]
    contrast = _contrast(image, grid)
    if contrast < 0:
        rows, columns = grid.shape[:2]
        if (rows + columns) % 2:
            grid, contrast = grid[::-1, ::-1], -contrast
        elif rows == columns and rows % 2:
            grid, contrast = np.rot90(grid), -contrast
    return grid if abs(contrast) >= ALTERNATING and _flat(grid) else None


def _axes(grid: Array) -> tuple[Array, Array]:
    """The mean directions (2,) of rows and columns."""
    return (grid[:, -1] - grid[:, 0]).mean(axis=0), (grid[-1] - grid[0]).mean(axis=0)


def _contrast(image: Grey, grid: Array) -> float:
    """1 when every inner square is darker or brighter than its neighbours as it should be with a
    dark square outside the first corner, -1 when all are the other way round."""
    centres = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4.0
    values = sample(image, centres)
    parity = 1.0 - 2.0 * (np.indices(values.shape).sum(axis=0) % 2)
    bright = np.concatenate(
        [
            (np.diff(values, axis=0) * parity[:-1]).ravel(),
            (np.diff(values, axis=1) * parity[:, :-1]).ravel(),
        ]
    )
    return float(np.mean(np.sign(bright))) if bright.size else 0.0


def _flat(grid: Array) -> bool:
    rows, columns = grid.shape[:2]
    places = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
    pixels = grid.reshape(-1, 2)
    H = direct_linear_transform(places.astype(float), pixels)
    off = np.linalg.norm(apply_homography(H, places) - pixels, axis=1)
    return bool(off.max() < STRAY * max(grid_spacing(grid), 1.0) + 1.0)


def _refined(image: Grey, grid: Array) -> Array | None:
    """Sub-pixel corners (n, 2), or None when one moves further than a finder can be wrong."""
    rough = grid.reshape(-1, 2)
    pixels = refine_crossings(image, rough, grid_axes(grid))
    limit = MOVED_PX * max(1.0, max(image.shape) / LONGEST_PX) + MOVED * grid_spacing(grid)
    moved = np.linalg.norm(pixels - rough, axis=1)
    return pixels if moved.max() < limit else None
