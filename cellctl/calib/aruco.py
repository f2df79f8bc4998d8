"""ArUco markers: dictionaries by name, detection, corners to a few hundredths of a pixel."""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from functools import cache
from typing import Any

import cv2
import numpy as np

from cellctl.calib.corners import Grey, cross, sample
from cellctl.errors import BadInput
from cellctl.geometry import Array, Mask

LINES, LINE_PX = (14, 20, 28, 38, 48), 1.5
"""Profiles across each side of a marker: about that far apart, one of these numbers."""
ROUNDED_PX, ROUNDED = 3.0, 0.08
"""What blur rounds at a corner, and what of a side is left out there at least."""
LEAST_MODULE_PX = 2.5
"""Smaller modules leave no room for an edge's profile: corners would be off by up to 2 px."""
STEP_PX = 0.5
STRAY_PX = 3.0
MINIMUM_CONTRAST = 8.0


@cache
def dictionary(name: str) -> Any:
    """OpenCV's predefined dictionary by its name, such as DICT_4X4_50; BadInput if unknown."""
    known = sorted(key for key in dir(cv2.aruco) if key.startswith("DICT_"))
    if name not in known:
        close = difflib.get_close_matches(str(name), known, n=1)
        hint = f"did you mean {close[0]}?" if close else f"known: {', '.join(known)}"
        raise BadInput(f"unknown ArUco dictionary {name!r}; {hint}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


@dataclass(frozen=True, eq=False)
class Markers:
    """Detected markers: `ids` (m,), ascending; `corners` (m, 4, 2) px, clockwise from the top
    left of the marker as printed."""

    ids: Array
    corners: Array

    def centres(self) -> Array:
        """(m, 2): where the diagonals cross, which perspective does not move."""
        a, b, c, d = np.moveaxis(self.corners, 1, 0)
        ac, bd, ab = c - a, d - b, b - a
        along = cross(ab, bd) / cross(ac, bd)
        return a + along[:, None] * ac


def find_markers(image: Grey, name: str, *, precise: bool = True) -> Markers:
    """All markers of a dictionary in the picture; ids that are seen twice are left out.

    `precise` corners are crossings of lines fitted to the sides: at 28 / 45 / 80 px per side
    they are several times better than OpenCV's, which refine each corner by itself. Markers
    whose sides do not show clearly are left out then.
    """
    markers = _detector(name).detectMarkers(image)
    if markers[1] is None or not len(markers[1]):
        return Markers(np.zeros(0, dtype=int), np.zeros((0, 4, 2)))
    ids = np.asarray(markers[1]).reshape(-1).astype(int)
    corners = np.asarray(markers[0], dtype=float).reshape(-1, 4, 2)
    order = np.argsort(ids, kind="stable")
    order = order[np.isin(ids[order], _once(ids))]
    ids, corners = ids[order], corners[order]
    if not precise or not len(ids):
        return Markers(ids, corners)
    corners, clear = refine_quads(image, corners, dictionary(name).markerSize + 2)
    return Markers(ids[clear], corners[clear])


@cache
def _detector(name: str) -> Any:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    return cv2.aruco.ArucoDetector(dictionary(name), parameters)


def _once(ids: Array) -> Array:
    values, counts = np.unique(ids, return_counts=True)
    return values[counts == 1]


def refine_quads(image: Grey, corners: Array, modules: int) -> tuple[Array, Mask]:
    """Corners (m, 4, 2) of dark squares on white, from lines fitted to their sides, and which
    squares (m,) show all sides clearly; the others keep their corners.

    `modules` is the side in modules, the black border being one wide: profiles stay within it
    and within a white margin as wide.
    """
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)
    refined = corners.copy()
    clear = sides.min(axis=1, initial=np.inf) > LEAST_MODULE_PX * modules
    wanted = 0.8 * sides.mean(axis=1) / LINE_PX
    lines = np.array(LINES)[np.argmin(np.abs(wanted[:, None] - LINES), axis=1)]
    for count in np.unique(lines[clear]):  # alike ones together, and no marker changes others
        some = np.flatnonzero(clear & (lines == count))
        refined[some], clear[some] = _refined(image, corners[some], modules, int(count))
    return refined, clear


def _refined(image: Grey, corners: Array, modules: int, lines: int) -> tuple[Array, Mask]:
    """As `refine_quads`, by so many profiles across each side."""
    refined, clear = corners, np.ones(len(corners), dtype=bool)
    for _ in range(2):
        crossings = _crossings(*_side_lines(image, refined, modules, lines))
        off = np.linalg.norm(crossings - corners, axis=-1).max(axis=-1, initial=0.0)
        clear &= off < STRAY_PX
        refined = np.where(clear[:, None, None], crossings, corners)
    return refined, clear


def _side_lines(image: Grey, corners: Array, modules: int, lines: int) -> tuple[Array, Array]:
    """A point (m, 4, 2) and a direction (m, 4, 2) of the line through each side's edge."""
    along = np.roll(corners, -1, axis=1) - corners
    length = np.linalg.norm(along, axis=-1, keepdims=True)
    along = along / np.maximum(length, 1e-9)
    outward = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    middle = corners + 0.5 * length * along
    reach = 0.5 - np.clip(ROUNDED_PX / np.maximum(length, 1e-9), ROUNDED, 0.15)
    places = length * reach * np.linspace(-1.0, 1.0, lines)
    feet = middle[..., None, :] + places[..., None] * along[..., None, :]
    offsets = _edge_offsets(image, feet, outward, length.min(axis=(1, 2)) / modules)
    intercept, slope = _fit_lines(places, offsets)
    return middle + intercept[..., None] * outward, along + slope[..., None] * outward


def _edge_offsets(image: Grey, feet: Array, outward: Array, modules: Array) -> Array:
    """How far (m, 4, l) the dark-to-bright edge lies outward of each foot (m, 4, l, 2), with
    profiles as long as the `modules` (m,) px of each marker allow.

    An edge of any symmetric blur lies where the area under its profile says: the integral of
    (I - dark) / (bright - dark) from -a to b is b - offset. Not-a-number where there is no edge.
    """
    inner = np.clip(0.6 * modules, 1.5, 4.0)
    outer = np.clip(0.75 * modules, 2.0, 4.0)
    count = int(np.ceil((inner + outer).max() / STEP_PX)) + 1
    steps = np.linspace(-inner, outer, count, axis=-1)[:, None, None, :, None]
    profile = sample(image, feet[..., None, :] + steps * outward[:, :, None, None, :])
    dark, bright = profile[..., :2].mean(axis=-1), profile[..., -2:].mean(axis=-1)
    rise = bright - dark
    mean = (profile[..., 1:] + profile[..., :-1]).mean(axis=-1) / 2.0
    inner, outer = inner[:, None, None], outer[:, None, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = outer - (inner + outer) * (mean - dark) / rise
    return np.where((rise > MINIMUM_CONTRAST) & (np.abs(offset) < outer), offset, np.nan)


def _fit_lines(x: Array, y: Array) -> tuple[Array, Array]:
    """y = a + b x over the last axis by least squares, then twice again without strays;
    a is not-a-number where fewer than half of the y are left."""
    weights = np.isfinite(y).astype(float)
    y = np.nan_to_num(y)
    a, b = _straight(x, y, weights)
    for _ in range(2):
        off = np.abs(y - a[..., None] - b[..., None] * x)
        scale = np.median(np.where(weights > 0, off, 0.0), axis=-1, keepdims=True)
        weights = weights * (off <= 4.0 * scale + 0.05)
        a, b = _straight(x, y, weights)
    enough = weights.sum(axis=-1) >= x.shape[-1] / 2
    return np.where(enough, a, np.nan), b


def _straight(x: Array, y: Array, weights: Array) -> tuple[Array, Array]:
    """Intercept and slope (...) of weighted least squares over the last axis."""
    total = np.maximum(weights.sum(axis=-1), 1e-9)
    mean_x, mean_y = (weights * x).sum(axis=-1) / total, (weights * y).sum(axis=-1) / total
    dx, dy = x - mean_x[..., None], y - mean_y[..., None]
    slope = (weights * dx * dy).sum(axis=-1) / np.maximum((weights * dx * dx).sum(axis=-1), 1e-9)
    return mean_y - slope * mean_x, slope


def _crossings(points: Array, directions: Array) -> Array:
    """Corners (m, 4, 2): each where a side meets the one before it."""
    before, turned = np.roll(points, 1, axis=1), np.roll(directions, 1, axis=1)
    gap = points - before
    along = cross(gap, directions) / cross(turned, directions)
    return before + along[..., None] * turned
