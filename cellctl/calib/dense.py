"""The projector map from Gray code on the table: tens of thousands of edges instead of markers.

A coarse grid of places, read from the edges around each, takes the part of markers: which of them
lie on the table, whether anything is mirrored, and where to begin. The map is then fitted to the
edges themselves. Each says one coordinate of the projector's pixel only, which is all that least
squares needs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cellctl.calib.camera import CameraModel
from cellctl.calib.graycode import GrayCode
from cellctl.calib.graycode_decode import Edges, Grey, decode
from cellctl.calib.graycode_local import at_places
from cellctl.calib.projector import (
    INLIER_SIGMAS,
    LensPrior,
    MapProblem,
    ProjectorResult,
    blocks,
    solve_projector,
)
from cellctl.calib.projector_map import ProjectorMap
from cellctl.calib.schur import minimise
from cellctl.errors import SolveError
from cellctl.geometry import Array

GRID = 28
"""Places across the longer side of what is lit."""
MOST_EDGES = 12000
"""Of columns, and of rows, that are kept: a step through them all, so that they lie everywhere."""
LEAST_REACH_PX, MOST_REACH_PX = 10.0, 40.0
HUBER = 4.0
LEAST_SIGMA_PX = 0.02


@dataclass(frozen=True, eq=False)
class CodeSeen:
    """What the camera saw of the code: `places` (m, 2) in its pixels with the projector's
    `pixels` (m, 2) there, and edges of columns and rows."""

    places: Array
    pixels: Array
    columns: Edges
    rows: Edges

    def to_dict(self) -> dict[str, Any]:
        """JSON form, to a thousandth of a pixel."""
        return {
            "grid": _listed(np.column_stack([self.places, self.pixels])),
            "columns": _listed(np.column_stack([self.columns.places, self.columns.values])),
            "rows": _listed(np.column_stack([self.rows.places, self.rows.values])),
        }

    @classmethod
    def from_dict(cls, value: Mapping[str, Any]) -> CodeSeen:
        grid = np.array(value["grid"], dtype=float).reshape(-1, 4)
        columns, rows = (
            np.array(value[k], dtype=float).reshape(-1, 3) for k in ("columns", "rows")
        )
        return cls(
            grid[:, :2],
            grid[:, 2:],
            Edges(columns[:, :2], columns[:, 2]),
            Edges(rows[:, :2], rows[:, 2]),
        )

    @property
    def markers(self) -> tuple[dict[int, Array], dict[int, Array]]:
        """Places and projector pixels {number: (2,)}, as of markers."""
        return dict(enumerate(self.places)), dict(enumerate(self.pixels))


def read_code(pictures: Sequence[Grey], code: GrayCode) -> CodeSeen:
    """Pure: from the pictures of a code, as `decode` takes them. SolveError when next to nothing
    can be read."""
    decoded = decode(pictures, code)
    columns, rows = decoded.columns, decoded.rows
    if min(len(columns), len(rows)) < GRID:
        raise SolveError(
            "the code cannot be read: is the projector in focus and on the table, and the camera's "
            "picture neither dark nor saturated? Wider stripes may help (stripe_px)"
        )
    every = np.concatenate([columns.places, rows.places])
    low, high = np.percentile(every, [0.5, 99.5], axis=0)
    step = float((high - low).max()) / GRID
    axes = [np.arange(a + step / 2, b, step) for a, b in zip(low, high, strict=True)]
    places = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    reach = np.clip(0.5 * step, LEAST_REACH_PX, MOST_REACH_PX)
    local = at_places(decoded, places, np.full(len(places), reach))
    good = local.found
    return CodeSeen(places[good], local.pixels[good], _some(columns), _some(rows))


def solve_dense(
    seen: CodeSeen, camera: CameraModel, *, lens: LensPrior | None = None
) -> ProjectorResult:
    """As `projector.solve_projector`, whose errors it raises; `used` and `rejected` are places of
    the grid. Errors are per point, of both coordinates together, as they are of markers. Held
    out is one of 3 x 3 blocks of the projector's picture."""
    places, pixels = seen.markers
    start = solve_projector([places], pixels, camera, lens=lens)
    edges = _Scalars.of(seen, camera)
    off = np.abs(edges.off(start.map))
    sigma = max(1.4826 * float(np.median(off)), LEAST_SIGMA_PX)
    kept = edges[off < INLIER_SIGMAS * sigma]
    fit = _fit(kept, lens, start.map, sigma)
    held_out = np.empty(len(kept.axes))
    fold = blocks(start.map.project(kept.xy))
    for one in np.unique(fold):
        rest = _fit(kept[fold != one], lens, fit, sigma)
        held_out[fold == one] = kept[fold == one].off(rest)
    px = _per_point(held_out, kept.axes)
    return replace(
        start, map=fit, rms_px=_per_point(kept.off(fit), kept.axes), held_out_px=px,
        held_out_used_px=px,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Scalars:
    """Edges of both axes: normalised camera coordinates (n, 2), the projector's coordinate (n,)
    and which of the two it is (n,)."""

    xy: Array
    values: Array
    axes: Array

    @classmethod
    def of(cls, seen: CodeSeen, camera: CameraModel) -> _Scalars:
        both = seen.columns, seen.rows
        xy = camera.normalise(np.concatenate([edges.places for edges in both]))
        axes = np.repeat([0, 1], [len(edges) for edges in both])
        found = cls(xy, np.concatenate([edges.values for edges in both]), axes)
        return found[np.isfinite(xy).all(axis=1)]

    def __getitem__(self, index: Any) -> _Scalars:
        return _Scalars(self.xy[index], self.values[index], self.axes[index])

    def off(self, fit: ProjectorMap) -> Array:
        return fit.project(self.xy)[np.arange(len(self.axes)), self.axes] - self.values


def _fit(
    edges: _Scalars, lens: LensPrior | None, start: ProjectorMap, sigma: float
) -> ProjectorMap:
    weights = np.eye(2)[edges.axes] / sigma
    pixels = np.repeat(edges.values[:, None], 2, axis=1)
    return minimise(MapProblem(edges.xy, pixels, lens, weights), start, huber=HUBER).state


def _per_point(errors: Array, axes: Array) -> float:
    """Root mean square length of the errors of points that have both coordinates."""
    return float(np.sqrt(sum(np.square(errors[axes == axis]).mean() for axis in (0, 1))))


def _some(edges: Edges) -> Edges:
    order = np.random.default_rng(0).permutation(len(edges))[:MOST_EDGES]
    return edges[np.sort(order)]


def _listed(array: Array) -> list[list[float]]:
    rows: list[list[float]] = np.round(array, 3).tolist()
    return rows
