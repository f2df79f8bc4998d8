"""Projector pixels of given camera pixels, from the edges of the code around each.

On a small part of a plane a homography maps the camera's picture to the projector's: the lenses
bend by far less than a pixel there. Each edge is one equation for its eight unknowns, so hundreds
of edges are averaged. D. Moreno, G. Taubin, 2012, section 4, fit such maps to whole codes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cellctl.calib.graycode_decode import Decoded, Edges
from cellctl.geometry import Array, Mask

LEAST_EDGES = 12
"""Of columns, and of rows: with fewer about a place nothing is told of it."""
SWEEPS = 6
TUKEY = 4.0
"""Edges that are further off than so many standard deviations have no say."""
AGREE = 0.6
"""Part of the edges about a place that must agree: across the border of two surfaces they do
not."""
LEAST_SIGMA, MOST_SIGMA = 0.02, 0.4
"""How far single edges are off: at least, projector px; at most, camera px. Edges of two surfaces
agree with nothing but a mean of both."""


MOST_EDGES = 300
"""Of columns, and of rows, that are asked: more take time and tell nothing new."""


@dataclass(frozen=True, eq=False)
class Local:
    """Projector pixels (n, 2), not-a-number where nothing is told; `slopes` (n, 2, 2) are their
    derivatives by the camera's pixels, `sigma` (n,) is how far a single edge is off, projector
    px."""

    pixels: Array
    slopes: Array
    sigma: Array

    @property
    def found(self) -> Mask:
        return np.asarray(np.isfinite(self.pixels).all(axis=1))


def at_places(decoded: Decoded, places: Array, reach: Array) -> Local:
    """At camera pixels (n, 2), from the edges within `reach` (n,) camera pixels of each, in a
    circle."""
    columns, rows = _Near(decoded.columns), _Near(decoded.rows)
    told = np.full((len(places), 7), np.nan)
    for i, (place, radius) in enumerate(zip(places, reach, strict=True)):
        fitted = _fit(columns.within(place, radius), rows.within(place, radius), place, radius)
        if fitted is not None:
            told[i] = np.concatenate([part.ravel() for part in fitted])
    return Local(told[:, :2], told[:, 2:6].reshape(-1, 2, 2), told[:, 6])


class _Near:
    """Edges sorted by their row in the picture, to find those around a place."""

    def __init__(self, edges: Edges) -> None:
        self._edges = edges[np.argsort(edges.places[:, 1], kind="stable")]

    def within(self, place: Array, radius: float) -> Edges:
        down = self._edges.places[:, 1]
        first, last = np.searchsorted(down, [place[1] - radius, place[1] + radius])
        band = self._edges[np.arange(first, last)]
        inside = np.flatnonzero(np.square(band.places - place).sum(axis=1) <= radius**2)
        return band[inside[:: 1 + len(inside) // MOST_EDGES]]


def _fit(
    columns: Edges, rows: Edges, place: Array, radius: float
) -> tuple[Array, Array, Array] | None:
    """The projector's pixel (2,) at a place, its slopes (2, 2), and how far single edges are
    off."""
    if min(len(columns), len(rows)) < LEAST_EDGES:
        return None
    middle = np.array([np.median(columns.values), np.median(rows.values)])
    across = _equations((columns.places - place) / radius, columns.values - middle[0], 0)
    down = _equations((rows.places - place) / radius, rows.values - middle[1], 3)
    A, y = (np.concatenate(pair) for pair in zip(across, down, strict=True))
    solution, off, sigma = _robust(A, y)
    linear, shift, perspective = solution[[[0, 1], [3, 4]]], solution[[2, 5]], solution[6:]
    slopes = (linear - np.outer(shift, perspective)) / radius
    scale = np.sqrt(abs(np.linalg.det(slopes)))
    if np.mean(off < TUKEY * sigma) < AGREE or sigma > max(MOST_SIGMA * scale, LEAST_SIGMA):
        return None
    return middle + shift, slopes, np.array(sigma)


def _equations(near: Array, values: Array, first: int) -> tuple[Array, Array]:
    """One row (8,) an edge: (a x + b y + c) - u (g x + h y) = u, with a b c from place `first`."""
    A = np.zeros((len(near), 8))
    A[:, first : first + 2], A[:, first + 2] = near, 1.0
    A[:, 6:] = -values[:, None] * near
    return A, values


def _robust(A: Array, y: Array) -> tuple[Array, Array, float]:
    """The solution of A x = y, how far each equation is off, and their robust deviation: least
    sums first, then Tukey's biweight."""
    weights = np.ones(len(y))
    tiny = 1e-9 * len(y) * np.diag(np.square(A).mean(axis=0))
    for sweep in range(SWEEPS):
        weighted = A * weights[:, None]
        solution = np.linalg.solve(weighted.T @ A + tiny, weighted.T @ y)
        off = np.abs(A @ solution - y)
        sigma = max(1.4826 * float(np.median(off)), LEAST_SIGMA)
        if sweep < SWEEPS // 2:
            weights = 1.0 / np.maximum(off, sigma / 2.0)
        else:
            weights = np.square(np.clip(1.0 - np.square(off / (TUKEY * sigma)), 0.0, None))
    return solution, off, sigma
