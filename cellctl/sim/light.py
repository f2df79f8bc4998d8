"""The projector's light: pictures in linear light, and what shades what in its beam."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import count

import cv2
import numpy as np

from cellctl.drivers.base import Image
from cellctl.geometry import Array
from cellctl.sim.bodies import Body
from cellctl.sim.region import Region, bounding
from cellctl.sim.truth import Truth
from cellctl.sim.view import Capsule, Capsules, Plate, View, meet, on_plane, tiled

GAMMA = 2.2
SHADOW_BINNING = 4
SHADOW_MARGIN_PX = 8
_numbers = count()


@dataclass(frozen=True, eq=False)
class Picture:
    """What is shown; `number` tells pictures apart without looking at their pixels."""

    image: Image
    number: int = field(default_factory=lambda: next(_numbers))

    def linear(self) -> Array:
        """(h, w) float32 of linear light, 1 = white."""
        image = self.image
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        table = ((np.arange(256) / 255.0) ** GAMMA).astype(np.float32)
        return cv2.LUT(grey, table)


Light = tuple[tuple[float, Picture | None], ...]
"""Shares of an exposure, and the picture that was on the glass (None: dark) during each."""


def mixed(light: Light) -> Array | None:
    """The mean light (h, w) float32 of an exposure; None when it was dark."""
    parts = [
        picture.linear() * np.float32(share)
        for share, picture in light
        if picture is not None and share > 0 and picture.image.any()
    ]
    if not parts:
        return None
    total = parts[0]
    for part in parts[1:]:
        total += part
    return total


class Beam:
    """What the projector's rays meet before the table, seen from the projector at a
    quarter of its resolution: which group of bodies is nearest."""

    def __init__(self, truth: Truth) -> None:
        self._view = View(truth.projector.lens, SHADOW_BINNING)
        self._T_lens_world = truth.projector.pose.inverse().matrix
        width, height = truth.projector.lens.size
        self.shape = (height, width)

    def cast(self, things: tuple[Body, ...], frames: Array) -> Shadows:
        """For `things` on an arm with true link frames `frames` (7, 4, 4)."""
        groups = {group: i + 1 for i, group in enumerate(dict.fromkeys(b.group for b in things))}
        depth = np.full(self._view.padded, np.inf, dtype=np.float32)
        owner = np.zeros(self._view.padded, dtype=np.uint8)
        placed = [(b, b.placed(frames, self._T_lens_world)) for b in things]
        for body, shape in placed:
            if isinstance(shape, Plate):
                self._mark_plate(shape, groups[body.group], depth, owner)
        round_ones = [(groups[b.group], s) for b, s in placed if isinstance(s, Capsule)]
        self._mark_capsules(round_ones, depth, owner)
        return Shadows(owner[: self._view.shape[0], : self._view.shape[1]], groups, self.shape)

    def _mark_plate(self, plate: Plate, group: int, depth: Array, owner: Array) -> None:
        part = self._view.region_of(plate.hull()).slices
        x, y, at = on_plane(plate.pose, self._view.rays[part])
        nearer = (plate.margin(x, y, at) >= 0) & (at < depth[part])
        np.copyto(depth[part], at, where=nearer)
        owner[part][nearer] = group

    def _mark_capsules(
        self, capsules: list[tuple[int, Capsule]], depth: Array, owner: Array
    ) -> None:
        shapes = Capsules.of([capsule for _, capsule in capsules])
        tiles = self._view.tiles_of(shapes)
        hits = meet(shapes[tiles.body], tiles.rays)
        depths, owners = tiled(depth), tiled(owner)
        for i, (group, _) in enumerate(capsules):
            mine, row, column = tiles.of(i)
            before = depths[row, column]
            nearer = (hits.margin[mine] >= 0) & (hits.depth[mine] < before)
            depths[row, column] = np.where(nearer, hits.depth[mine], before)
            owners[row, column] = np.where(nearer, np.uint8(group), owners[row, column])


@dataclass(frozen=True, eq=False)
class Shadows:
    """`owner` (h/4, w/4) uint8: 0 where light reaches the table, else the number of the group
    that it meets first."""

    owner: Array
    groups: dict[str, int]
    shape: tuple[int, int]

    def region(self, group: str | None = None) -> Region:
        """Where in the projector's picture the light meets `group`, or any body at all."""
        mask = self.owner > 0 if group is None else self.owner == self.groups[group]
        found = bounding(mask)
        return found.times(SHADOW_BINNING).grown(SHADOW_MARGIN_PX, self.shape) if found else found

    def mask(self, region: Region, group: str | None = None) -> Array:
        """Share (h, w) float32 of the light in `region` that reaches `group`, or the table."""
        n = SHADOW_BINNING
        number = 0 if group is None else self.groups[group]
        rows = slice(region.top // n, -(-region.bottom // n))
        columns = slice(region.left // n, -(-region.right // n))
        mask = (self.owner[rows, columns] == number).astype(np.float32)
        size = (mask.shape[1] * n, mask.shape[0] * n)
        fine = cv2.resize(mask, size, interpolation=cv2.INTER_LINEAR)
        top, left = region.top % n, region.left % n
        return fine[
            top : top + region.bottom - region.top, left : left + region.right - region.left
        ]
