"""What stands around the arm, and what of it the pen may touch."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from cellctl.geometry import Array, Mask

TABLE = "comes too near to the table"
ENDLESS = np.array([[-np.inf, -np.inf], [np.inf, np.inf]])
"""The top of a table whose edges nobody has stated."""


@dataclass(frozen=True, eq=False)
class Keepout:
    """A box (`low`, `high`) in the world, each (3,), that no sphere may touch."""

    name: str
    low: Array
    high: Array


@dataclass(frozen=True, eq=False)
class Pen:
    """What may touch the table: `tip` (3,) in the flange frame gives way by `travel`, and may be
    down on `sheets` (n, 2, 2), lowest and highest (x, y) each, in the world; metres."""

    tip: Array
    travel: float
    sheets: Array

    def tips(self, flanges: Array) -> Array:
        """Tips (n, 3) in the world for T_world_flange (n, 4, 4)."""
        return flanges[..., :3, :3] @ self.tip + flanges[..., :3, 3]

    def on_sheet(self, xy: Array) -> Mask:
        """Whether each of xy (n, 2) lies on a sheet."""
        inside = (xy[:, None] >= self.sheets[:, 0]) & (xy[:, None] <= self.sheets[:, 1])
        return np.logical_or.reduce(np.logical_and.reduce(inside, axis=2), axis=1)


@dataclass(frozen=True, eq=False)
class Scene:
    """What stands around the arm, in the world frame, metres. `balls`: (name, centre, radius).

    The table is solid below `table_height`, within `table_top` (corners (2, 2), lowest first):
    everywhere where that is infinite."""

    box_low: Array
    box_high: Array
    table_height: float
    keepouts: tuple[Keepout, ...]
    balls: tuple[tuple[str, Array, float], ...]
    table_top: Array = field(default_factory=lambda: ENDLESS)

    def near_table(self, centres: Array, reach: Array) -> Mask:
        """Whether spheres at (n, m, 3) come nearer to the table than `reach` (m,): (n, m)."""
        height = centres[..., 2] - self.table_height
        near = height < reach
        if not np.isinf(self.table_top).all() and near.any():
            low, high = self.table_top
            beside = np.maximum(low - centres[..., :2], centres[..., :2] - high).clip(min=0.0)
            near &= (beside**2).sum(axis=-1) + height.clip(min=0.0) ** 2 < reach**2
        return near

    def names(self) -> list[str]:
        """What a body must not do, in the order of `broken`."""
        return [
            "leaves the workspace box",
            TABLE,
            *(f"enters keep-out {keepout.name!r}" for keepout in self.keepouts),
            *(f"comes too near to the {name}" for name, _, _ in self.balls),
        ]

    def broken(self, centres: Array, reach: Array) -> list[Mask]:
        """Which of spheres at (n, m, 3) do so, `reach` (m,) being their radii with what they have
        to keep: (n, m) each."""
        room = np.minimum(centres - self.box_low, self.box_high - centres).min(axis=2)
        broken = [room < reach, self.near_table(centres, reach)]
        for keepout in self.keepouts:
            away = np.maximum(keepout.low - centres, centres - keepout.high).clip(min=0.0)
            broken.append((away**2).sum(axis=-1) < reach**2)
        for _, centre, radius in self.balls:
            broken.append(((centres - centre) ** 2).sum(axis=-1) < (reach + radius) ** 2)
        return broken
