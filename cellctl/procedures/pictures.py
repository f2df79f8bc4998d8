"""Pictures of the paper: blank, with drawn circles, with projected rings around them.

The arm is out of the light in all of them. What was found is journalled with the picture.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from cellctl.calib.calibration import Calibration
from cellctl.calib.circles import Expected, find_circles
from cellctl.calib.printed import Unseen
from cellctl.cell import Cell
from cellctl.drivers.base import Image
from cellctl.geometry import Array, Mask
from cellctl.procedures.capture import darken, grab_still, mean_image
from cellctl.procedures.parking import park_again
from cellctl.run import Run

PICTURES, BLANK = "pictures", "blank"
FRAMES = 4
DETECT_TIMEOUT_S = 60.0
RING_FACTOR, RING_WIDTH_PX, RING_POINTS = 1.6, 3, 180
"""A ring is projected around each circle, so much larger, so wide; as a polygon."""
SUBPIXEL_BITS = 8
LOOKS, GLARE = 24, 240
"""At so many places of a circle the blank paper must be darker than that."""


@dataclass(frozen=True, eq=False)
class Sight:
    """A picture of the blank paper: where circles, and what is `factor` times as large around them,
    could be seen in it."""

    image: Image
    base: Calibration
    factor: float = 1.0

    def shows(self, xy: Array, radius: float) -> Mask:
        """Whether circles of `radius` metres about world xy (n, 2) are in the picture, and not lost
        in glare: (n,)."""
        angles = np.linspace(0.0, 2 * np.pi, LOOKS, endpoint=False)
        around = self.factor * radius * np.column_stack([np.cos(angles), np.sin(angles)])
        pixels = self.base.picture((xy[:, None] + around).reshape(-1, 2))
        grey = self.image if self.image.ndim == 2 else self.image.max(axis=2)
        at = np.rint(np.nan_to_num(pixels, nan=-1.0, posinf=-1.0, neginf=-1.0)).astype(int)
        inside = ((at > 0) & (at < np.array(grey.shape[::-1]) - 1)).all(axis=1)
        column, row = np.clip(at, 0, np.array(grey.shape[::-1]) - 1).T
        good = inside & (grey[row, column] < GLARE)
        return np.logical_and.reduce(good.reshape(len(xy), LOOKS), axis=1)


@dataclass(frozen=True, eq=False)
class Circle:
    """A circle of `radius` metres that was drawn on a sheet about `xy` (2,) as commanded,
    `measured` (2,) as the arm measured itself, world frame; the tool was turned by `yaw`. Rounds
    are counted from 0."""

    key: str
    round: int
    sheet: str
    xy: Array
    measured: Array
    yaw: float
    radius: float


Found = dict[str, dict[str, Any]]
"""What a picture shows of each circle: `centre_px`, `radius_m`, `seen`, or `unseen`: why not."""


async def blank(run: Run, cell: Cell, base: Calibration) -> None:
    """The paper under white light before anything of this run is drawn."""
    await run.step(PICTURES)
    if BLANK not in run.samples():
        image = await _take(run, cell, base, BLANK, _white(cell))
        await run.sample(BLANK, {}, {"image": image})


async def sight(run: Run, base: Calibration, factor: float = 1.0) -> Sight:
    """What the picture of the blank paper says."""
    blank_picture = run.samples(PICTURES)[BLANK].images["image"]
    return Sight(await asyncio.to_thread(blank_picture.load), base, factor)


async def of_circles(
    run: Run, cell: Cell, base: Calibration, key: str, circles: Sequence[Circle], search_m: float
) -> None:
    """Under white light, and where the circles are in it."""
    await run.step(PICTURES)
    if key in run.samples():
        return
    image = await _take(run, cell, base, key, _white(cell))
    before = run.samples()[BLANK].images["image"]
    search = Search(base, search_m, cell.config.bracket.pen.line_m)
    found = await run.call(
        find_drawn,
        image,
        await asyncio.to_thread(before.load),
        search,
        circles,
        timeout_s=DETECT_TIMEOUT_S,
    )
    await run.sample(key, {"found": found}, {"image": image})


async def with_rings(
    run: Run, cell: Cell, calibration: Calibration, key: str, circles: Sequence[Circle],
    search_m: float,
) -> None:  # fmt: skip
    """With rings that `calibration` puts around the circles, and where both are in it."""
    await run.step(PICTURES)
    if key in run.samples():
        return
    size = cell.config.projector.size_px
    shown = await run.call(rings, calibration, circles, size)
    image = await _take(run, cell, calibration, key, shown)
    search = Search(calibration, search_m, cell.config.bracket.pen.line_m)
    found = await run.call(find_drawn_and_lit, image, search, circles, timeout_s=DETECT_TIMEOUT_S)
    await run.sample(key, found, {"image": image})


async def _take(run: Run, cell: Cell, base: Calibration, key: str, shown: Image) -> Image:
    await park_again(run, cell, base.T_world_camera, key)
    await run.step(PICTURES)
    await run.checkpoint(f"{key} is shown")
    async with run.taking(key):
        on_glass = await cell.projector.show(shown)
        frames = await grab_still(cell, on_glass, FRAMES)
        image: Image = await asyncio.to_thread(mean_image, frames)
    await darken(cell)
    return image


def _white(cell: Cell) -> Image:
    width, height = cell.config.projector.size_px
    return np.full((height, width), 255, np.uint8)


@dataclass(frozen=True, eq=False)
class Search:
    """Where circles are looked for: where `base` has them, within `radius` metres, drawn with
    lines of `line` metres."""

    base: Calibration
    radius: float
    line: float

    def expected(self, circles: Sequence[Circle], factor: float = 1.0) -> list[Expected]:
        return [Expected(c.key, c.measured, factor * c.radius) for c in circles]


def find_drawn(
    image: Image, before: Image | None, search: Search, circles: Sequence[Circle]
) -> Found:
    """Pure: the drawn circles in a picture."""
    return _find(image, search, search.expected(circles), search.line, "dark", before)


def find_drawn_and_lit(image: Image, search: Search, circles: Sequence[Circle]) -> dict[str, Found]:
    """Pure: `drawn` circles and projected ones (`lit`) in one picture."""
    lit = search.expected(circles, RING_FACTOR)
    width = RING_WIDTH_PX * _metres_per_pixel(search.base)
    return {
        "drawn": _find(image, search, search.expected(circles), search.line, "dark", None),
        "lit": _find(image, search, lit, width, "bright", None),
    }


def _find(image: Image, search: Search, expected: list[Expected], line: float, polarity: Any,
          before: Image | None) -> Found:  # fmt: skip
    base = search.base
    found = find_circles(
        image,
        base.camera,
        base.table_frame,
        expected,
        search_m=search.radius,
        line_m=line,
        polarity=polarity,
        before=before,
    )
    return {key: _circle_data(item) for key, item in found.items()}


def _circle_data(item: Any) -> dict[str, Any]:
    if isinstance(item, Unseen):
        return {"unseen": item.reason}
    return {
        "centre_px": [float(v) for v in item.centre_px],
        "radius_m": float(item.radius_m),
        "seen": float(item.seen),
        "rms_px": float(item.rms_px),
    }


def _metres_per_pixel(base: Calibration) -> float:
    """On the table, of the projector's pixels."""
    middle = base.project(base.table.point[None])
    two = base.locate(middle + np.array([[0.0, 0.0], [1.0, 0.0]]))
    return float(np.linalg.norm(two[1] - two[0]))


def rings(calibration: Calibration, circles: Sequence[Circle], size: tuple[int, int]) -> Image:
    """The projector's picture (h, w) of rings around the circles, anti-aliased."""
    width, height = size
    image = np.zeros((height, width), np.uint8)
    angles = np.linspace(0.0, 2 * np.pi, RING_POINTS, endpoint=False)
    unit = np.column_stack([np.cos(angles), np.sin(angles)])
    for circle in circles:
        around = circle.measured + RING_FACTOR * circle.radius * unit
        pixels = calibration.project(around)
        corners = np.rint(pixels * 2**SUBPIXEL_BITS).astype(np.int32)
        cv2.polylines(
            image, [corners[:, None]], True, 255, RING_WIDTH_PX, cv2.LINE_AA, SUBPIXEL_BITS
        )
    return image
