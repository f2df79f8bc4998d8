"""Ink as the camera sees it: how much of each pixel is covered by lines on the paper.

Each pixel near a line is divided into SUB x SUB parts. Distance and direction of the nearest point
of the line, measured on the paper through the true lens and over the table's bow, say how much of
a part is covered: its edge is straight there. The lens blurs the parts; the sensor's pixels
gather what comes through. The other way round, a line thinner than a pixel would snap to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from cellctl.geometry import Array, Mask
from cellctl.sim.paper import Ink, Line, Sheet
from cellctl.sim.region import NOWHERE, Region
from cellctl.sim.truth import Truth

SUB = 4
INK_ALBEDO = 0.08
"""Of paper: what a line reflects of what paper does."""
FINE_SHARE = 1 / 16
"""Points along a line are at most this share of its width apart: then the distance to the nearest
one is that to the line, within a thousandth of the width."""
CLOSE_PX = 0.71 + 0.5
"""From a pixel's middle to its farthest corner, and from a point to the middle of its pixel."""
OBLIQUE = 1.3
"""A pixel may be this much smaller on the table than one in the middle."""
SIGMAS = 4.0
STEPS = 4096
"""Of coverage: a line that is drawn again, a picometre elsewhere, is the same picture."""


@dataclass(frozen=True, eq=False)
class Mark:
    """The first `count` points of a line as the camera sees them: pixels `rows`, `columns` (n,)
    in `region`, and the share of each one's parts that is `covered` (n, SUB, SUB)."""

    count: int
    region: Region
    rows: Array
    columns: Array
    covered: Array


class Inking:
    """What ink leaves of the paper's brightness, `left` (padded h, w) float32, over a table whose
    places (x, y), in table coordinates, every camera pixel sees."""

    def __init__(self, truth: Truth, places: tuple[Array, Array]) -> None:
        self._truth, self._places = truth, places
        self._sheets = {sheet.number: sheet for sheet in truth.sheets}
        self._sigma = truth.preset.camera.defocus_px
        self._marks: dict[int, Mark] = {}
        self.left = np.ones(places[0].shape, np.float32)

    def show(self, ink: Ink) -> list[Region]:
        """Show this ink and no other; returns where `left` has changed."""
        wanted = {line.number: (line, count) for line, count in ink if line.sheet in self._sheets}
        old = [n for n, mark in self._marks.items() if mark.count != wanted.get(n, (None, 0))[1]]
        changed = [self._marks.pop(number).region for number in old]
        for number, (line, count) in wanted.items():
            if number not in self._marks:
                self._marks[number] = self._mark(line, count)
                changed.append(self._marks[number].region)
        return [self._blur(region) for region in changed if region]

    def _mark(self, line: Line, count: int) -> Mark:
        course = _dense(line.places[:count], line.width * FINE_SHARE)
        on_table = self._sheets[line.sheet].on_table(course)
        pixels = self._truth.camera.project(self._truth.table.surface(on_table))
        region, mask = self._near(pixels, self._reach(line.width))
        rows, columns = np.nonzero(mask)
        rows, columns = rows + region.top, columns + region.left
        return Mark(
            count, region, rows, columns, self._coverage(on_table, line.width, rows, columns)
        )

    def _coverage(self, course: Array, width: float, rows: Array, columns: Array) -> Array:
        """Share (n, SUB, SUB) of parts of pixels covered by a line along `course` (m, 2)."""
        if not len(rows):
            return np.empty((0, SUB, SUB), np.float32)
        places, across, down = (self._look(rows, columns, i) for i in range(3))
        steps = (np.arange(SUB) + 0.5) / SUB - 0.5
        dx, dy = (a.reshape(-1, 1) for a in np.meshgrid(steps, steps))
        parts = places[:, None] + dx * across[:, None] + dy * down[:, None]
        sides = np.stack([across, down], axis=1)[:, None] / SUB
        reach = width / 2 + float(np.abs(sides).sum(axis=2).max())
        distance, nearest = cKDTree(course).query(parts, distance_upper_bound=reach)
        away = parts - np.vstack([course, course[:1]])[nearest]
        away /= np.maximum(np.hypot(*np.moveaxis(away, -1, 0)), 1e-12)[..., None]
        spans = np.abs((sides * away[:, :, None]).sum(axis=-1))
        share = _half_plane(width / 2 - distance, spans[..., 0], spans[..., 1])
        return (np.round(share * STEPS) / STEPS).astype(np.float32).reshape(-1, SUB, SUB)

    def _look(self, rows: Array, columns: Array, which: int) -> Array:
        """Of pixels: 0 the place on the table (n, 2), 1 and 2 its change to the right and down."""
        if which == 0:
            return np.stack([a[rows, columns] for a in self._places], axis=1).astype(float)
        down, right = (1, 0) if which == 2 else (0, 1)
        height, width = self._places[0].shape
        after = np.minimum(rows + down, height - 1), np.minimum(columns + right, width - 1)
        before = np.maximum(rows - down, 0), np.maximum(columns - right, 0)
        gap = (after[0] - before[0] + after[1] - before[1])[:, None]
        found = np.stack([a[after].astype(float) - a[before] for a in self._places], axis=1)
        return np.asarray(found / gap)

    def _near(self, pixels: Array, reach: int) -> tuple[Region, Mask]:
        """The region around `pixels` (n, 2), and which of its pixels are within `reach`."""
        shape = self.left.shape
        nearest = np.round(pixels).astype(int)
        low, high = nearest.min(axis=0) - reach, nearest.max(axis=0) + reach + 1
        region = Region(int(low[0]), int(low[1]), int(high[0]), int(high[1])).cropped(shape)
        if not region:
            return NOWHERE, np.empty((0, 0), bool)
        mask = np.zeros((region.bottom - region.top, region.right - region.left), np.uint8)
        x, y = nearest[:, 0] - region.left, nearest[:, 1] - region.top
        inside = (x >= 0) & (y >= 0) & (x < mask.shape[1]) & (y < mask.shape[0])
        mask[y[inside], x[inside]] = 1
        return region, cv2.dilate(mask, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0

    def _reach(self, width: float) -> int:
        camera = self._truth.camera
        scale = camera.lens.focal.max() / self._truth.preset.camera.height_m
        return int(OBLIQUE * width / 2 * scale + CLOSE_PX)

    def _blur(self, region: Region) -> Region:
        """Bring `left` up to date where ink in `region` is seen, blurred."""
        reach = int(np.ceil(SIGMAS * self._sigma))
        seen = region.grown(reach, self.left.shape)
        wide = seen.grown(reach, self.left.shape)
        parts = self._parts(wide)
        sigma, size = self._sigma * SUB, 2 * reach * SUB + 1
        blurred = cv2.GaussianBlur(parts, (size, size), sigma, borderType=cv2.BORDER_REPLICATE)
        width, height = wide.right - wide.left, wide.bottom - wide.top
        gathered = cv2.resize(blurred, (width, height), interpolation=cv2.INTER_AREA)
        inner = seen.moved(-wide.left, -wide.top).slices
        self.left[seen.slices] = 1 - np.float32(1 - INK_ALBEDO) * gathered[inner]
        return seen

    def _parts(self, region: Region) -> Array:
        """Coverage (SUB h, SUB w) of the parts of a region; lines that cross are as black as
        one."""
        height, width = region.bottom - region.top, region.right - region.left
        parts = np.zeros((height, SUB, width, SUB), np.float32)
        for mark in self._marks.values():
            if not region.meets(mark.region):
                continue
            rows, columns = mark.rows - region.top, mark.columns - region.left
            here = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
            at = (rows[here], slice(None), columns[here], slice(None))
            parts[at] = np.maximum(parts[at], mark.covered[here])
        return parts.reshape(height * SUB, width * SUB)


def paper(sheets: Sequence[Sheet], x: Array, y: Array) -> Array:
    """How far inside of any sheet (h, w) float32 table places are, metres; negative beside."""
    inside = np.full(x.shape, -np.inf, np.float32)
    for sheet in sheets:
        c, s = np.float32(np.cos(sheet.turn)), np.float32(np.sin(sheet.turn))
        dx, dy = (a - np.float32(o) for a, o in zip((x, y), sheet.centre, strict=True))
        along = np.float32(sheet.half[0]) - np.abs(c * dx + s * dy)
        across = np.float32(sheet.half[1]) - np.abs(c * dy - s * dx)
        np.maximum(inside, np.minimum(along, across), out=inside)
    return inside


def _half_plane(inside: Array, a: Array, b: Array) -> Array:
    """Share of parallelograms whose middle is `inside` a straight edge (negative: outside), and
    whose sides span `a` and `b` across it: two boxes, convolved and integrated."""
    a, b = np.maximum(a, b), np.maximum(np.minimum(a, b), 1e-3 * np.maximum(a, b) + 1e-12)
    inside = np.clip(inside, -a, a)
    far, near = (a + b) / 2, (a - b) / 2
    ramps = [np.maximum(inside + at, 0.0) ** 2 for at in (far, near, -near, -far)]
    return np.asarray((ramps[0] - ramps[1] - ramps[2] + ramps[3]) / (2 * a * b))


def _dense(places: Array, step: float) -> Array:
    """Points (m, 2) along a polyline (n, 2), at most `step` apart."""
    gaps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(gaps)])
    if way[-1] == 0.0:
        return places[:1]
    at = np.linspace(0.0, way[-1], 2 + int(way[-1] / step))
    if len(places) < len(at) / 4:  # few corners, which count
        at = np.union1d(at, way)
    return np.column_stack([np.interp(at, way, places[:, i]) for i in range(2)])
