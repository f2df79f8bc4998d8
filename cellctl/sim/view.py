"""The pixels of a lens as rays, and where rays meet solid things.

Rays are normalised coordinates (x, y), z = 1, in the lens's optical frame. Functions of the
pixel that are smooth are evaluated on a coarse grid and interpolated by cubic splines. What a
body covers is worked out on the tiles that it can touch, and nowhere else.

How far inside a silhouette a ray passes is its margin, an angle in radians (negative: outside).
Margins are smooth, so they are worked out coarsely and made into sharp edges afterwards.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_interp_spline

from cellctl.geometry import Array
from cellctl.sim.lens import Lens
from cellctl.sim.region import NOWHERE, Region

TILE = 16
NEAR_M = 0.01
"""What is nearer than this to a lens's plane is not seen."""
OUTSIDE = -1.0
GRAZING = 1e-5
"""Rays that rise less than this over a plane are taken to rise this much."""
GRID_STEP_PX = 32
Normal = tuple[Array, Array, Array]


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays (x, y, 1), both arrays of the same shape, float32."""

    x: Array
    y: Array

    def dot(self, vector: Array) -> Array:
        """Products with a vector (3,), or with vectors (3, ...) that broadcast."""
        a, b, c = np.asarray(vector, dtype=np.float32)
        product: Array = self.x * a
        product += self.y * b
        product += c
        return product

    def __getitem__(self, part: tuple[slice, slice]) -> Rays:
        return Rays(self.x[part], self.y[part])


@dataclass(frozen=True, eq=False)
class Capsule:
    """A solid in a lens's frame: within `radius` of the segment from `start` to `end` (3,)."""

    start: Array
    end: Array
    radius: float


@dataclass(frozen=True, eq=False)
class Plate:
    """A thin rectangle: `pose` (4, 4) lens from plate, its middle `centre` and `half` sizes (2,)
    in the plate's x, y."""

    pose: Array
    centre: Array
    half: Array

    def hull(self) -> Capsule:
        """A capsule around the plate."""
        long = int(np.argmax(self.half))
        middle = self.pose[:3, :2] @ self.centre + self.pose[:3, 3]
        reach = self.pose[:3, long] * self.half[long]
        return Capsule(middle - reach, middle + reach, float(self.half.min()))

    def margin(self, x: Array, y: Array, depth: Array) -> Array:
        """Margins (...,) of rays that meet the plate's plane at (x, y) and `depth`."""
        (cx, cy), (hx, hy) = self.centre.astype(np.float32), self.half.astype(np.float32)
        inside = np.minimum(hx - np.abs(x - cx), hy - np.abs(y - cy))
        inside /= np.maximum(depth, np.float32(NEAR_M))
        return np.where(depth > NEAR_M, inside, np.float32(OUTSIDE))

    def normal(self) -> Normal:
        """Unit normal, as three numbers, of the side that the lens sees."""
        x, y, z = (self.pose[:3, 2] * (-1.0 if self.faces_away() else 1.0)).astype(np.float32)
        return x, y, z

    def faces_away(self) -> bool:
        """Whether the lens looks along the plate's z axis: at a board, that it sees the front."""
        return float(self.pose[:3, 2] @ self.pose[:3, 3]) > 0


@dataclass(frozen=True, eq=False)
class Capsules:
    """Many of them: `start`, `axis` (n, 3), `radius` (n,)."""

    start: Array
    axis: Array
    radius: Array

    @classmethod
    def of(cls, capsules: Sequence[Capsule]) -> Capsules:
        start = np.array([c.start for c in capsules]).reshape(-1, 3)
        end = np.array([c.end for c in capsules]).reshape(-1, 3)
        return cls(start, end - start, np.array([c.radius for c in capsules]))

    def grown(self, spread: float) -> Capsules:
        """Grown by a cone of half angle `spread` from the lens."""
        reach = np.maximum(self.start[:, 2], (self.start + self.axis)[:, 2])
        radius = self.radius + spread * (np.maximum(reach, 0) + self.radius)
        return Capsules(self.start, self.axis, radius)

    def distance(self) -> Array:
        """From the lens to the axes (n,), metres."""
        square = np.maximum((self.axis**2).sum(1), 1e-12)
        along = np.clip(-(self.start * self.axis).sum(1) / square, 0.0, 1.0)
        return np.linalg.norm(self.start + along[:, None] * self.axis, axis=1)

    def __getitem__(self, which: Array) -> Capsules:
        return Capsules(self.start[which], self.axis[which], self.radius[which])


@dataclass(frozen=True, eq=False)
class Tiles:
    """Pairs of a body and a tile that it may touch: `body`, `row`, `column` (p,); `rays`
    (p, T, T)."""

    body: Array
    row: Array
    column: Array
    rays: Rays

    def of(self, body: int) -> tuple[Array, Array, Array]:
        """Those of one body: their places in the list, rows, columns."""
        mine = np.nonzero(self.body == body)[0]
        return mine, self.row[mine], self.column[mine]


@dataclass(frozen=True, eq=False)
class Hits:
    """Where rays meet bodies, arrays of the rays' shape: margin in radians, depth along the
    optical axis (that of the nearest approach where they pass), unit normal towards the lens."""

    margin: Array
    depth: Array
    normal: Normal


def dense(function: Callable[[Array], Array], shape: tuple[int, int], step: int) -> Array:
    """`function` of pixels (..., 2) -> (..., k), at every pixel of `shape`: (k, h, w) float32.

    Evaluated every `step` pixels at most; exact to the fourth order between.
    """
    rows, columns = (np.linspace(0, n - 1, max(-(-n // step), 3) + 1) for n in shape)
    values = function(np.stack(np.meshgrid(columns, rows), axis=-1))
    down, across = (_weights(nodes, n) for nodes, n in zip((rows, columns), shape, strict=True))
    layers = [down @ value @ across.T for value in np.moveaxis(values, -1, 0)]
    return np.array(layers, dtype=np.float32)


def _weights(nodes: Array, count: int) -> Array:
    """(count, len(nodes)): how the cubic spline through values at `nodes` depends on them, at
    0, 1, ... count - 1."""
    weights: Array = make_interp_spline(nodes, np.eye(len(nodes)), k=3)(np.arange(count))
    return weights


class View:
    """The rays of a lens; with `binning` n, of the middles of blocks of n x n pixels.

    `shape` is that of the binned picture, `padded` the next whole number of tiles, which `rays`
    have; `pixel` is the angle that one binned pixel spans, radians.
    """

    def __init__(self, lens: Lens, binning: int = 1) -> None:
        width, height = (-(-n // binning) for n in lens.size)
        self.lens, self.binning = lens, binning
        self.shape = (height, width)
        self.padded = (-(-height // TILE) * TILE, -(-width // TILE) * TILE)
        self.pixel = binning / float(lens.focal.mean())
        self.rays = Rays(*dense(self._rays_at, self.padded, max(GRID_STEP_PX // binning, 1)))
        x, y = tiled(self.rays.x), tiled(self.rays.y)
        self._tiles = Rays(x, y)
        self._middles = Rays(x.mean(axis=(2, 3)), y.mean(axis=(2, 3)))
        across = x[:, :, 0, 0] - self._middles.x, y[:, :, 0, 0] - self._middles.y
        self._spread = 1.5 * float(np.hypot(*across).max()) + self.pixel

    def tiles_of(self, capsules: Capsules) -> Tiles:
        """Which of the capsules may touch which tiles."""
        grown = capsules.grown(self._spread)
        touched = meet(grown, self._middles).margin >= 0
        touched |= (grown.distance() <= grown.radius)[:, None, None]
        body, row, column = np.nonzero(touched)
        return Tiles(
            body, row, column, Rays(self._tiles.x[row, column], self._tiles.y[row, column])
        )

    def region_of(self, capsule: Capsule) -> Region:
        """A region, whole tiles, outside which `capsule` is not."""
        tiles = self.tiles_of(Capsules.of([capsule]))
        if not len(tiles.row):
            return NOWHERE
        (top, bottom), (left, right) = ((a.min(), a.max() + 1) for a in (tiles.row, tiles.column))
        return Region(int(left), int(top), int(right), int(bottom)).times(TILE)

    def _rays_at(self, places: Array) -> Array:
        pixels = places * self.binning + (self.binning - 1) / 2
        return self.lens.rays(pixels)[..., :2]


def tiled(picture: Array) -> Array:
    """View (rows, columns, T, T) of a padded picture (h, w)."""
    height, width = picture.shape
    blocks = picture.reshape(height // TILE, TILE, width // TILE, TILE)
    return np.swapaxes(blocks, 1, 2)


def on_plane(pose: Array, rays: Rays) -> tuple[Array, Array, Array]:
    """Where rays meet the plane z = 0 of `pose` (4, 4): x and y there, depth."""
    x_axis, y_axis, normal, origin = pose[:3].T
    slope = rays.dot(normal)
    np.copyto(slope, np.float32(GRAZING), where=np.abs(slope) < GRAZING)
    depth = np.float32(normal @ origin) / slope
    x = depth * rays.dot(x_axis) - np.float32(x_axis @ origin)
    y = depth * rays.dot(y_axis) - np.float32(y_axis @ origin)
    return x, y, depth


def meet(capsules: Capsules, rays: Rays) -> Hits:
    """Rays (n, h, w) against n capsules, each its own; or rays (h, w) against all n. They meet
    its cylinder, or the ball at the end beyond which they would enter that."""
    start, axis = capsules.start, capsules.axis
    square = np.maximum((axis**2).sum(1), 1e-12)
    slant = (start * axis).sum(1)
    c = _columns((start**2).sum(1) - slant**2 / square - capsules.radius**2)
    per_square, slant, radius = (_columns(v) for v in (1 / square, slant, capsules.radius))
    r_start, r_axis = rays.dot(_columns(start.T)), rays.dot(_columns(axis.T))
    rr = rays.x * rays.x + rays.y * rays.y + np.float32(1.0)
    # The infinite cylinder, everything taken across the axis: a t^2 + 2 b t + c = 0.
    a = np.maximum(rr - r_axis * r_axis * per_square, np.float32(1e-9))
    b = r_axis * (slant * per_square) - r_start
    inside = b * b / a - c  # radius^2 minus the squared distance between ray and axis
    depth = (-b - np.sqrt(np.maximum(inside, 0) * a)) / a
    along = (depth * r_axis - slant) * per_square
    for beyond, end, r_end in (
        (along < 0, start, r_start),
        (along > 1, start + axis, r_start + r_axis),
    ):
        ball = r_end * r_end / rr - _columns((end**2).sum(1) - capsules.radius**2)
        np.copyto(inside, ball, where=beyond)
        entry = (r_end - np.sqrt(np.maximum(ball, 0) * rr)) / rr
        np.copyto(depth, entry, where=beyond)
    distance = np.maximum(depth, np.float32(NEAR_M)) * np.sqrt(rr)
    margin = inside * (np.float32(0.5) / radius) / distance
    np.copyto(margin, np.float32(OUTSIDE), where=depth <= NEAR_M)
    return Hits(margin, depth, _normal(capsules, rays, depth, np.clip(along, 0, 1)))


def _normal(capsules: Capsules, rays: Rays, depth: Array, along: Array) -> Normal:
    """Outward unit normals at hits."""
    start, axis = _columns(capsules.start.T), _columns(capsules.axis.T)
    over = 1 / _columns(capsules.radius)
    return (
        (depth * rays.x - start[0] - along * axis[0]) * over,
        (depth * rays.y - start[1] - along * axis[1]) * over,
        (depth - start[2] - along * axis[2]) * over,
    )


def _columns(values: Array) -> Array:
    """(..., n) as (..., n, 1, 1) float32: one for each picture of a stack."""
    return values.astype(np.float32)[..., None, None]
