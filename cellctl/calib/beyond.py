"""Does the print of a board go on beyond what was found of it? Then it is another board.

A finder that is asked for 8x6 corners is happy with a part of a board of 9x6, and another part in
the next picture.
"""

from __future__ import annotations

import numpy as np

from cellctl.calib.corners import Grey, grid_axes, sample
from cellctl.geometry import Array

REACH, STEPS = 0.45, 6
"""Half the window that is compared, in steps of the grid, and its samples on either side."""
ALIKE, STRENGTH = 0.8, 0.3
"""A place looks like the print when its correlation with the found points' mean reaches this, and
its contrast that part of theirs. At a chessboard's rim three quadrants are alike: 0.58."""
SHARE, LEAST = 0.8, 3
"""The print goes on when that part of a side's places in the picture, of so many at least, do."""
MARGIN_PX = 2.0


def print_goes_on(image: Grey, grid: Array, *, alternating: bool) -> bool:
    """Whether on any side of a found grid of pixels (rows, columns, 2) another row or column of
    the same print follows. `alternating`: each point is the negative of its neighbours, as a
    chessboard's crossings are."""
    points = _extended(grid)
    rows, columns = points.shape[:2]
    patches = _patches(image, points)
    if alternating:
        patches = patches * (1.0 - 2.0 * (np.indices((rows, columns)).sum(axis=0) % 2))[..., None]
    mean = patches[1:-1, 1:-1].mean(axis=(0, 1))
    strength = patches @ mean / max(float(mean @ mean), 1e-9)
    norms = np.linalg.norm(patches, axis=-1) * np.linalg.norm(mean)
    alike = (patches @ mean > ALIKE * norms) & (strength > STRENGTH)
    inside = _inside(image, points)
    return any(
        np.count_nonzero(seen) >= LEAST and np.mean(like[seen]) >= SHARE
        for like, seen in zip(_sides(alike), _sides(inside), strict=True)
    )


def _sides(values: Array) -> list[Array]:
    """First and last row and column of (rows, columns), without their corners."""
    return [values[0, 1:-1], values[-1, 1:-1], values[1:-1, 0], values[1:-1, -1]]


def _extended(grid: Array) -> Array:
    """The grid with one more row and column on each side, by quadratic extrapolation, which
    follows perspective and lens closely enough."""
    for axis in (0, 1):
        a, b, c = (np.take(grid, [i], axis=axis) for i in (0, 1, 2))
        z, y, x = (np.take(grid, [i], axis=axis) for i in (-1, -2, -3))
        grid = np.concatenate([3 * a - 3 * b + c, grid, 3 * z - 3 * y + x], axis=axis)
    return grid


def _patches(image: Grey, points: Array) -> Array:
    """(rows, columns, k): what is seen around each point, in the grid's own axes, mean zero."""
    axes = grid_axes(points).reshape(*points.shape[:2], 2, 2)
    steps = np.linspace(-REACH, REACH, 2 * STEPS + 1)
    window = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    values = sample(image, points[:, :, None] + window @ axes)
    return np.asarray(values - values.mean(axis=-1, keepdims=True))


def _inside(image: Grey, points: Array) -> Array:
    """Whether (rows, columns) the whole window of a point is in the picture."""
    axes = np.abs(grid_axes(points)).sum(axis=1).reshape(points.shape)
    h, w = image.shape
    low, high = points - REACH * axes, points + REACH * axes
    return np.logical_and(low > MARGIN_PX, high < np.array([w, h]) - 1 - MARGIN_PX).all(axis=-1)
