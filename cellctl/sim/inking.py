"""Ink as the camera sees it: how much of each pixel is covered by lines on the paper.

Each pixel near a line is divided into SUB x SUB parts; the distance of each part's middle to the
line, measured on the paper through the true lens and over the table's bow, says how much of the
part is covered. Then the lens blurs it.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.spatial import cKDTree

from cellctl.geometry import Array, Mask
from cellctl.sim.paper import Ink, Line, Sheet
from cellctl.sim.region import Region
from cellctl.sim.truth import Truth

SUB = 6
INK_ALBEDO = 0.08
"""Of paper: what a line reflects of what paper does."""
FINE_SHARE = 1 / 10
"""Points along a line are at most this share of its width apart: then the distance to the nearest
one is that to the line, within a four-hundredth of the width."""
CLOSE_PX = 0.71 + 0.5
"""From a pixel's middle to its farthest corner, and from a point to the middle of its pixel."""
OBLIQUE = 1.3
"""A pixel may be this much smaller on the table than one in the middle."""
SIGMAS = 4.0


class Inking:
    """What ink leaves of the paper's brightness, (padded h, w) float32, over a table whose places
    (x, y), in table coordinates, every camera pixel sees."""

    def __init__(self, truth: Truth, places: tuple[Array, Array]) -> None:
        self._truth, self._places = truth, places
        self._sheets = {sheet.number: sheet for sheet in truth.sheets}
        self._sigma = truth.preset.camera.defocus_px
        self._covered = np.zeros(places[0].shape, np.float32)
        self._seen: dict[int, int] = {}
        self.left = np.ones(places[0].shape, np.float32)

    def add(self, ink: Ink) -> list[Region]:
        """Take ink in; returns where `left` has changed. Ink that is there stays."""
        changed = []
        for line, count in ink:
            if line.sheet in self._sheets and self._seen.get(line.number, 0) < count:
                self._seen[line.number] = count
                changed += self._cover(line, count)
        return [self._blur(region) for region in changed]

    def holds_more(self, ink: Ink) -> bool:
        """Whether there is ink here that is not in `ink`: a picture of earlier is asked for."""
        asked = {line.number: count for line, count in ink}
        return any(asked.get(number, 0) < count for number, count in self._seen.items())

    def _cover(self, line: Line, count: int) -> list[Region]:
        course = _dense(line.places[:count], line.width * FINE_SHARE)
        on_table = self._sheets[line.sheet].on_table(course)
        pixels = self._truth.camera.project(self._truth.table.surface(on_table))
        region, mask = self._near(pixels, self._reach(line.width))
        if not region:
            return []
        rows, columns = np.nonzero(mask)
        rows, columns = rows + region.top, columns + region.left
        covered = self._coverage(on_table, line.width, rows, columns)
        self._covered[rows, columns] = np.maximum(self._covered[rows, columns], covered)
        return [region]

    def _coverage(self, course: Array, width: float, rows: Array, columns: Array) -> Array:
        """Share (n,) of pixels (rows, columns) covered by a line along `course` (m, 2)."""
        places, across, down = (self._look(rows, columns, i) for i in range(3))
        steps = (np.arange(SUB) + 0.5) / SUB - 0.5
        dx, dy = (a.reshape(-1, 1) for a in np.meshgrid(steps, steps))
        parts = places[:, None] + dx * across[:, None] + dy * down[:, None]
        size = float(np.sqrt(np.abs(_cross(across, down)).mean())) / SUB
        distance, _ = cKDTree(course).query(
            parts.reshape(-1, 2), distance_upper_bound=width / 2 + size
        )
        share = np.clip((width / 2 - distance) / size + 0.5, 0.0, 1.0)
        return share.reshape(len(rows), -1).mean(axis=1).astype(np.float32)

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
        shape = self._covered.shape
        nearest = np.round(pixels).astype(int)
        low, high = nearest.min(axis=0) - reach, nearest.max(axis=0) + reach + 1
        region = Region(int(low[0]), int(low[1]), int(high[0]), int(high[1])).cropped(shape)
        if not region:
            return region, np.empty((0, 0), bool)
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
        shape, reach = self._covered.shape, int(np.ceil(SIGMAS * self._sigma))
        seen = region.grown(reach, shape)
        wide = seen.grown(reach, shape)
        blurred = cv2.GaussianBlur(
            self._covered[wide.slices], (2 * reach + 1, 2 * reach + 1), self._sigma
        )
        inner = seen.moved(-wide.left, -wide.top).slices
        self.left[seen.slices] = 1 - np.float32(1 - INK_ALBEDO) * blurred[inner]
        return seen


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


def _cross(a: Array, b: Array) -> Array:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
