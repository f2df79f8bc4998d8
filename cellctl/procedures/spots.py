"""Where to touch or draw: spots on the free parts of the sheets that the pen can reach, spread
over the area to its edges, or where circles tell most of the map. Pure and deterministic: the same
seed and paper give the same spots.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from cellctl.calib.design import choose_circles
from cellctl.config import CellConfig, SheetSection
from cellctl.geometry import Array, Mask
from cellctl.procedures.pen import PenRig
from cellctl.procedures.routing import nearest_first
from cellctl.store.sheets import Spot

CANDIDATES = 500
ON_EDGE = 0.3
"""Share of the candidates that lies on each pair of edges of the area."""
YAWS_DEG = (0.0, 180.0, 30.0, -150.0, -30.0, 150.0, 60.0, -120.0, -60.0, 120.0, 90.0, -90.0)
MARGIN_M = 0.008
"""Free paper between two lines."""


class Sight(Protocol):
    """A camera on the paper."""

    def shows(self, xy: Array, radius: float) -> Mask:
        """Whether circles about xy (n, 2) can be seen: (n,)."""
        ...


Used = Sequence[tuple[str, Spot]]
"""Spots with the name of their sheet."""


@dataclass(frozen=True, eq=False)
class PlannedSpot:
    """A spot `xy` (2,) on a sheet, the tool's `yaw` (rad) there, and joints (6,) above it."""

    sheet: str
    xy: Array
    yaw: float
    joints: Array

    def to_dict(self) -> dict[str, Any]:
        return {
            "sheet": self.sheet,
            "xy": self.xy.tolist(),
            "yaw": self.yaw,
            "joints": self.joints.tolist(),
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> PlannedSpot:
        return cls(data["sheet"], np.array(data["xy"]), data["yaw"], np.array(data["joints"]))


def plan_spots(
    rig: PenRig,
    config: CellConfig,
    used: Used,
    count: int,
    radius: float,
    seed: int,
    turned: bool = True,
    sight: Sight | None = None,
    telling: bool = False,
) -> list[PlannedSpot]:
    """Up to `count` spots for circles of `radius` metres, far from each other, best spread first;
    `telling`: those first from which the map of the area is known best.

    With `turned` the tool's yaw changes from spot to spot as far as the guard allows, so that what
    is off at the tool can be told from what is off in the cell; without, it is 0 where the guard
    allows that. With `sight`, only where a line would be seen.
    """
    rng = np.random.default_rng(seed)
    xy = _candidates(config, rng)
    owner = _sheet_of(config.sheets, xy, radius)
    taken = np.array([(s.x, s.y) for _, s in used]).reshape(-1, 2)
    reach = np.array([s.radius_m for _, s in used]) + radius + MARGIN_M
    near = np.linalg.norm(xy[:, None] - taken, axis=2) < reach
    seen = np.ones(len(xy), bool) if sight is None else sight.shows(xy, radius)
    free = (owner >= 0) & seen & ~np.logical_or.reduce(near, axis=1)
    xy, owner = xy[free], owner[free]
    if not len(xy):
        return []
    allowed, above = _postures(rig, xy, radius)
    spacing = 2 * radius + MARGIN_M
    usable = np.logical_or.reduce(allowed, axis=1)
    if telling:
        chosen = _telling(config, xy, usable, count, spacing)
    else:
        chosen = _spread(xy, usable, count, spacing)
    spots = []
    for place, i in enumerate(chosen):
        turn = _turn(allowed[i], place if turned else 0)
        name, yaw = config.sheets[owner[i]].name, float(np.radians(YAWS_DEG[turn]))
        spots.append(PlannedSpot(name, xy[i], yaw, above[i, turn]))
    return spots


def area(config: CellConfig) -> tuple[Array, Array]:
    """Lowest and highest (x, y) of the area that is calibrated and drawn in, in the world: around
    the middle of the sheets, which were laid there; without sheets, of the table by tape."""
    half = np.array(config.table.area_m) / 2
    middle = np.array(config.table.pose.position_m[:2])
    if config.sheets:
        low = np.min([sheet.min_m for sheet in config.sheets], axis=0)
        high = np.max([sheet.max_m for sheet in config.sheets], axis=0)
        middle = (low + high) / 2
    return middle - half, middle + half


def _candidates(config: CellConfig, rng: np.random.Generator) -> Array:
    """Points (CANDIDATES, 2) all over the area, many of them on its edges."""
    low, high = area(config)
    share = rng.uniform(0.0, 1.0, (CANDIDATES, 2))
    edge = rng.uniform(0.0, 1.0, (CANDIDATES, 2)) < ON_EDGE
    return low + np.where(edge, np.round(share), share) * (high - low)


def _sheet_of(sheets: Sequence[SheetSection], xy: Array, radius: float) -> Array:
    """Index (n,) of the sheet on which a circle about each of xy (n, 2) lies wholly; -1: none."""
    owner = np.full(len(xy), -1)
    for i, sheet in enumerate(sheets):
        low, high = np.array(sheet.min_m) + radius, np.array(sheet.max_m) - radius
        owner[((xy >= low) & (xy <= high)).all(axis=1)] = i
    return owner


def _postures(rig: PenRig, xy: Array, radius: float) -> tuple[Mask, Array]:
    """At which of YAWS_DEG the pen may be lowered to each of xy (n, 2): (n, yaws), and the joints
    (n, yaws, 6) above. Looked at on four sides of the circle, by a cautious guard."""
    n, turns = len(xy), len(YAWS_DEG)
    places = np.repeat(xy, turns, axis=0)
    yaw = np.tile(np.radians(YAWS_DEG), n)
    above, good = rig.postures(places, yaw, rig.lift)
    allowed = good.copy()
    guard = rig.guard.cautious(rig.posture)
    allowed[good] = guard.free(above[good])
    for side in radius * np.array([(1, 0), (-1, 0), (0, 1), (0, -1)]):
        down, found = rig.postures(places[allowed] + side, yaw[allowed], -rig.depth)
        allowed[allowed] = np.logical_and(found, guard.draws(down))
    return allowed.reshape(n, turns), above.reshape(n, turns, -1)


def _turn(allowed: Mask, place: int) -> int:
    """The first of the yaws (yaws,) that are allowed, beginning with another one at every spot."""
    turns = len(YAWS_DEG)
    return next(k % turns for k in range(place, place + turns) if allowed[k % turns])


def _telling(config: CellConfig, xy: Array, allowed: Mask, count: int, spacing: float) -> list[int]:
    """Up to `count` of xy (n, 2), after each of which the map of the area is known best."""
    usable = np.flatnonzero(allowed)
    chosen = choose_circles(xy[usable], *area(config), count, spacing)
    return [int(usable[i]) for i in chosen]


def _spread(xy: Array, allowed: Mask, count: int, spacing: float) -> list[int]:
    """Up to `count` of xy (n, 2), farthest-point sampling (Gonzalez 1985), from a corner on; no two
    nearer than `spacing`."""
    if not allowed.any():
        return []
    away = np.where(allowed, np.linalg.norm(xy - xy.mean(axis=0), axis=1), -1.0)
    chosen = [int(np.argmax(away))]
    distance = np.where(allowed, np.linalg.norm(xy - xy[chosen[0]], axis=1), -1.0)
    while len(chosen) < count and distance.max() >= spacing:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(xy - xy[chosen[-1]], axis=1))
    return chosen


def in_order(rig: PenRig, spots: list[PlannedSpot], chunk: int) -> list[PlannedSpot]:
    """The spots, `chunk` by `chunk`, each chunk as the arm gets around in it soonest."""
    ordered: list[PlannedSpot] = []
    here = rig.posture
    for start in range(0, len(spots), chunk):
        some = spots[start : start + chunk]
        ordered += [some[i] for i in nearest_first(here, np.array([s.joints for s in some]))]
        here = ordered[-1].joints
    return ordered
