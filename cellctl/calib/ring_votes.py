"""Where thin dark rings may be in a flat picture: every piece of line votes for the centres that
it may curve about, across its own direction (the Hough transform with directions: C. Kimme,
D. Ballard and J. Sklansky, Finding circles by an array of accumulators, 1975).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from scipy.spatial import cKDTree

from cellctl.calib.plane_view import Flat
from cellctl.geometry import Array, Mask

SOFTEN, TENSOR = 0.7, 1.5
"""Cells: blur before lines are sought, and reach over which their direction is averaged."""
CLEAR = 5.0
"""A line is darker than its surroundings by so many times what noise makes."""
LEAST_DEPTH = 1.5
"""Grey levels; what is fainter is no line in any light."""
BLUR_OF_VOTES = 1.2
APART = 2.5
"""Cells: rings whose centres and radii differ by less are one."""
LEAST_SHARE = 0.22
"""Of a ring's circumference that must vote for a centre."""
SCATTER = 0.75
"""How widely a whole ring's votes scatter, in cells: a measured value."""


@dataclass(frozen=True, eq=False)
class Lines:
    """Pieces of thin dark lines: places (n, 2) in cells, and unit normals (n, 2)."""

    cells: Array
    normals: Array


@dataclass(frozen=True, eq=False)
class Candidates:
    """Rings that may be there: centres (n, 2) metres on the plane, radii (n,) metres, and
    `votes` (n,), about the share of the circumference that speaks for them."""

    centres: Array
    radii: Array
    votes: Array

    def __getitem__(self, index: Array) -> Candidates:
        return Candidates(self.centres[index], self.radii[index], self.votes[index])


def thin_lines(flat: Flat, line_m: float) -> Lines:
    """The crests of lines that are not wider than about `line_m`.

    What is dark and narrow is what a closing fills (black top-hat): unlike a second derivative
    it does not answer beside bright lines, at steps, or in smooth light.
    """
    soft = cv2.GaussianBlur(flat.values, (0, 0), SOFTEN)
    side = 2 * int(np.ceil((line_m / flat.cell_m + 2.5) / 2.0)) + 1
    element = np.ones((side, side), np.uint8)
    depth = cv2.morphologyEx(soft, cv2.MORPH_CLOSE, element) - soft
    seen = cv2.erode(flat.seen.astype(np.uint8), np.ones((side + 2, side + 2), np.uint8)) > 0
    inner = np.zeros_like(seen)
    inner[2:-2, 2:-2] = seen[2:-2, 2:-2]
    rows, columns = np.nonzero(inner & (depth > _clear(depth[seen])))
    normals = _normals(soft, rows, columns)
    steps = np.rint(normals).astype(int)
    here = depth[rows, columns]
    crest = here >= depth[rows + steps[:, 1], columns + steps[:, 0]]
    crest &= here > depth[rows - steps[:, 1], columns - steps[:, 0]]
    return Lines(np.stack([columns, rows], axis=-1)[crest].astype(float), normals[crest])


def _clear(depth: Array) -> float:
    """The depth beyond which noise does not go."""
    if not depth.size:
        return LEAST_DEPTH
    sample = depth[:: max(1, depth.size // 50_000)]
    middle = float(np.median(sample))
    return middle + max(LEAST_DEPTH, CLEAR * 1.4826 * float(np.median(np.abs(sample - middle))))


def _normals(soft: Array, rows: Array, columns: Array) -> Array:
    """(n, 2) directions across the line at each cell: the stronger axis of the structure tensor."""
    x, y = cv2.Sobel(soft, cv2.CV_32F, 1, 0), cv2.Sobel(soft, cv2.CV_32F, 0, 1)
    xx, xy, yy = (
        cv2.GaussianBlur(product, (0, 0), TENSOR)[rows, columns]
        for product in (x * x, x * y, y * y)
    )
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def vote(lines: Lines, flat: Flat, radii: Array, wanted: Mask) -> Candidates:
    """Peaks of the votes for rings of `radii` (k,) metres with centres where `wanted` (h, w)."""
    found = [_peaks(lines, flat, float(radius), wanted) for radius in radii]
    every = Candidates(
        np.concatenate([c.centres for c in found]),
        np.concatenate([c.radii for c in found]),
        np.concatenate([c.votes for c in found]),
    )
    return every[_strongest(every, APART * flat.cell_m)]


def _strongest(candidates: Candidates, near_m: float) -> Array:
    """Numbers of the candidates that have no stronger one of about the same centre and radius."""
    pairs = cKDTree(np.column_stack([candidates.centres, candidates.radii])).query_pairs(
        near_m, output_type="ndarray"
    )
    votes = candidates.votes[pairs]
    weaker = np.where(votes[:, 0] < votes[:, 1], pairs[:, 0], pairs[:, 1])
    return np.setdiff1d(np.arange(len(candidates.votes)), weaker)


def _peaks(lines: Lines, flat: Flat, radius: float, wanted: Mask) -> Candidates:
    h, w = flat.values.shape
    reach = radius / flat.cell_m * lines.normals
    targets = np.rint(np.concatenate([lines.cells + reach, lines.cells - reach])).astype(int)
    inside = ((targets >= 0) & (targets < (w, h))).all(axis=1)
    flat_index = targets[inside, 1] * w + targets[inside, 0]
    counts = np.bincount(flat_index, minlength=h * w).reshape(h, w).astype(np.float32)
    whole = radius / flat.cell_m / (BLUR_OF_VOTES**2 + SCATTER**2)  # 2 pi r / (2 pi sigma^2)
    share: Any = cv2.GaussianBlur(counts, (0, 0), BLUR_OF_VOTES) / whole
    top = (share >= cv2.dilate(share, np.ones((5, 5), np.uint8))) & (share > LEAST_SHARE) & wanted
    rows, columns = np.nonzero(top)
    centres = flat.origin + np.stack([columns, rows], axis=-1) * flat.cell_m
    return Candidates(centres, np.full(len(rows), radius), share[rows, columns].astype(float))
