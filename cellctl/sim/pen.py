"""The pen: where it touches the table while the arm moves, and what it leaves there.

It sits on the flange in a holder with a spring: pushed against something, it gives way along its
own axis, the flange's z. What a motion will write is known when the motion begins, point by point
with its time; when the motion is stopped, what lies ahead is worked out again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from cellctl.arms import JOINTS
from cellctl.geometry import Array
from cellctl.sim.paper import ALWAYS, Ink, Line, Sheet, printed
from cellctl.sim.truth import Truth

NONE = np.zeros(3)
NEAR_M = 0.05
"""A tip that is higher than this over the table touches nothing."""


@dataclass(frozen=True, eq=False)
class Press:
    """The pen at times `t` (n,): the table's surface under it, `xy` (n, 2) in table coordinates,
    and how far it is pushed in, `depth` (n,) in metres (negative: as far from touching)."""

    t: Array
    xy: Array
    depth: Array

    def first(self, depth: float) -> float | None:
        """When it is first pushed in by `depth`, interpolated; None: never."""
        deep = np.nonzero(self.depth >= depth)[0]
        if not len(deep):
            return None
        after = int(deep[0])
        before = max(after - 1, 0)
        rise = float(self.depth[after] - self.depth[before])
        share = float(depth - self.depth[before]) / rise if rise > 0 else 0.0
        return float(self.t[before] + share * (self.t[after] - self.t[before]))


class Pen:
    """The pen of one cell and all ink on its table."""

    def __init__(self, truth: Truth) -> None:
        self._truth = truth
        self._lines: list[Line] = []
        self._numbers = 0
        self.slip = NONE
        """Where it has slipped to (3,) in the flange frame, until it is lifted."""
        self.strokes = 0
        """How many strokes have begun."""
        self.stroke: int | None = None
        """The number of the one that is being drawn."""
        self.dry = False
        self.way_left = np.inf
        """For how many metres the ink still flows in this stroke."""

    def belongs_to(self, truth: Truth) -> None:
        self._truth = truth

    def press(self, t: Array, frames: Array) -> Press:
        """At times (n,), on true link frames (n, 7, 4, 4)."""
        table = self._truth.table
        flanges = frames[:, JOINTS]
        axes = flanges[:, :3, 2]
        tips = flanges[:, :3, :3] @ (self._truth.pen + self.slip) + flanges[:, :3, 3]
        with np.errstate(all="ignore"):
            hits = table.hit(tips, axes)
            xy = table.pose.inverse().apply(hits)[:, :2]
            depth = ((tips - hits) * axes).sum(axis=1)
            off = ~(np.abs(xy) <= table.half_top).all(axis=1) | ~(axes[:, 2] < 0)
        # A pen that lies nearly flat meets the table's surface far from its tip, or its parabola
        # where there is no table: it touches only what its tip is near to.
        places = table.pose.inverse().apply(tips)
        off |= places[:, 2] - table.height(places[:, :2]) > NEAR_M
        depth[off] = -np.inf
        return Press(t, xy, depth)

    def write(self, press: Press) -> None:
        """Leave ink where the pen presses onto paper, as long as the ink lasts."""
        if self.dry or not len(press.t):
            return
        down, over = press.depth >= 0, np.full(len(press.t), -1)
        for i, sheet in enumerate(self._truth.sheets):
            over[down & sheet.under(press.xy)] = i
        edges = np.nonzero(np.diff(over, prepend=-1, append=-1))[0]
        for start, end in pairwise(edges.tolist()):
            if over[start] >= 0:
                self._line(self._truth.sheets[over[start]], press, slice(start, end))

    def unwrite(self, now: float) -> None:
        """Forget what would have been written after `now`."""
        kept = []
        for line in self._lines:
            n = line.until(now)
            if n < len(line.t):
                self.way_left += _way(line.places) - _way(line.places[:n])
            if n:
                kept.append(replace(line, t=line.t[:n], places=line.places[:n]))
        self._lines = kept

    def weaken(self, press: Press, share: float) -> None:
        """Ink for `share` of the way that the pen is down in the stroke `press` is of."""
        self.way_left = share * _way(press.xy[press.depth >= 0])

    def print(self, sheet: Sheet, width: float) -> None:
        """Put print onto a sheet."""
        for places in printed(sheet):
            self._add(sheet, None, width, np.full(len(places), ALWAYS), places)

    def ink(self, t: float) -> Ink:
        """All ink at `t`."""
        found = ((line, line.until(t)) for line in self._lines)
        return tuple((line, n) for line, n in found if n)

    def forget(self, sheets: set[int]) -> None:
        """Drop the ink of all sheets but those with these numbers."""
        self._lines = [line for line in self._lines if line.sheet in sheets]

    def _line(self, sheet: Sheet, press: Press, part: slice) -> None:
        t, places = press.t[part], sheet.inside(press.xy[part])
        way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])
        n = int(np.searchsorted(way, self.way_left, "right")) if self.way_left > 0 else 0
        self.way_left = max(self.way_left - float(way[-1]), 0.0)
        if n:
            width = self._truth.preset.pen.line_m
            self._add(sheet, self.stroke, width, t[:n], places[:n])

    def _add(self, sheet: Sheet, stroke: int | None, width: float, t: Array, xy: Array) -> None:
        self._lines.append(Line(self._numbers, sheet.number, stroke, width, t, xy))
        self._numbers += 1


def _way(places: Array) -> float:
    return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
