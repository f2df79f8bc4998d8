"""Finding a grid of dark dots.

The centre of gravity of a circle's picture is not the picture of its centre; by how much follows
from the plane's homography and the dots' radius, which the picture shows: J. Heikkila,
Geometric camera calibration using circular control points, 2000.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import cv2
import numpy as np

from cellctl.calib.beyond import print_goes_on
from cellctl.calib.corners import Grey, cross, grid_spacing, sample
from cellctl.calib.printed import Unseen, lattice, neighbours
from cellctl.calib.projector_map import apply_homography, direct_linear_transform
from cellctl.geometry import Array

STEPS = 40
STRAY = 0.25
"""How far a dot may be from a plane's picture, in distances between neighbours; a lens bends by
less."""
STRAYS = "the dots are too small or too blurred to be told apart: move the camera nearer"
GOES_ON = "the grid goes on beyond {}x{} dots: count the board's dots"


def find_dots(image: Grey, counts: tuple[int, int]) -> Array | Unseen:
    """Centres (n, 2) in pixels, row by row, right-handed; or why not all are in sight.

    Nothing tells one end of a plain grid from the other: the first dot is the one from which
    the finder happens to begin.
    """
    h, w = image.shape
    flags = cv2.CALIB_CB_SYMMETRIC_GRID | cv2.CALIB_CB_CLUSTERING
    found, centres = cv2.findCirclesGrid(image, counts, flags=flags, blobDetector=_blobs(w * h))
    if not found or centres is None:
        return Unseen()
    grid = np.asarray(centres, dtype=float).reshape(counts[1], counts[0], 2)
    if cross(grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]) < 0:
        grid = grid[:, ::-1]
    if not _flat(grid, counts):
        return Unseen(STRAYS)
    if print_goes_on(image, grid, alternating=False):
        return Unseen(GOES_ON.format(*counts))
    return _without_perspective(image, grid.reshape(-1, 2), counts)


def _flat(grid: Array, counts: tuple[int, int]) -> bool:
    """Whether the dots (rows, columns, 2) lie where a plane's picture has them: the finder may
    take something else for a dot that it misses."""
    places, pixels = lattice(counts, 1.0)[:, :2], grid.reshape(-1, 2)
    H = direct_linear_transform(places, pixels)
    off = np.linalg.norm(apply_homography(H, places) - pixels, axis=1)
    return bool(off.max() < STRAY * grid_spacing(grid))


@cache
def _blobs(picture_area: int) -> Any:
    """Dark and roughly round, from 5 px across to a hundredth of the picture."""
    parameters = cv2.SimpleBlobDetector.Params()
    parameters.minArea, parameters.maxArea = 20.0, picture_area / 100.0
    parameters.minDistBetweenBlobs = 5.0
    parameters.minCircularity, parameters.filterByCircularity = 0.6, True
    return cv2.SimpleBlobDetector.create(parameters)


def _without_perspective(image: Grey, pixels: Array, counts: tuple[int, int]) -> Array:
    """The pictures (n, 2) of the dots' centres from their centres of gravity (n, 2)."""
    places = lattice(counts, 1.0)[:, :2]
    H = direct_linear_transform(places, pixels)
    shift = _centres_of_gravity(H, places, _radius(image, H, counts)) - apply_homography(H, places)
    return pixels - shift


def _radius(image: Grey, H: Array, counts: tuple[int, int]) -> float:
    """Radius of the dots in their spacing: where, on the way to a neighbour, half of the
    contrast is reached; the median over all."""
    ends = neighbours(lattice(counts, 1.0)[:, :2], counts)
    along = np.linspace(0.0, 0.5, STEPS)[:, None]
    places = ends[:, :1] * (1.0 - along) + ends[:, 1:] * along
    values = sample(image, apply_homography(H, places))
    level = (values[:, :3].mean(axis=1) + values[:, -3:].mean(axis=1)) / 2.0
    return float(np.median(np.argmax(values > level[:, None], axis=1))) / (STEPS - 1) / 2.0


def _centres_of_gravity(H: Array, places: Array, radius: float) -> Array:
    """Pixels (n, 2): centres of the ellipses in which circles about places (n, 2) are seen.

    The dual conic of a circle, H (c c^T - r^2 diag(1, 1, 0)) H^T, holds its centre in the last
    column: Hartley and Zisserman, Multiple View Geometry, 2nd edition, section 2.2.3.
    """
    centres = np.column_stack([places, np.ones(len(places))])
    dual = centres[:, :, None] * centres[:, None, :] - radius**2 * np.diag([1.0, 1.0, 0.0])
    seen = H @ dual @ H.T
    return seen[:, :2, 2] / seen[:, 2:, 2]
