"""Paper on the table, and the ink on it.

Ink is kept in its sheet's coordinates (metres from the sheet's middle), so it moves with the
sheet and goes when the sheet goes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cellctl.geometry import Array, Mask

PRINT_M = 0.5e-3
"""Width of printed lines."""
PRINT_GRID_M = 0.06
PRINT_EDGE_M = 0.012
ALWAYS = -1e12
"""When print was put onto its sheet: before anybody looked."""


@dataclass(frozen=True, eq=False)
class Sheet:
    """A rectangle of paper: middle `centre` (2,) and direction `turn` (rad) of its x axis in the
    table's xy, `half` sizes (2,) in metres. `number` is its own: another sheet of the same name
    has another one."""

    name: str
    number: int
    centre: Array
    turn: float
    half: Array

    def inside(self, xy: Array) -> Array:
        """Sheet coordinates (..., 2) of table xy (..., 2)."""
        return (xy - self.centre) @ _rotation(self.turn)

    def on_table(self, places: Array) -> Array:
        """Table xy (..., 2) of sheet coordinates (..., 2)."""
        return places @ _rotation(self.turn).T + self.centre

    def under(self, xy: Array) -> Mask:
        """Whether table xy (..., 2) lies on this sheet."""
        return np.logical_and.reduce(np.abs(self.inside(xy)) <= self.half, axis=-1)

    def moved(self, shift: Array, turn: float) -> Sheet:
        """Shifted (2,) along the table's axes and turned about its own middle."""
        return replace(self, centre=self.centre + shift, turn=self.turn + turn)


@dataclass(frozen=True, eq=False)
class Line:
    """A line on sheet `sheet` (its number): `places` (n, 2) in that sheet's coordinates, written
    at times `t` (n,), ascending; of `stroke` or, None, left by another motion or printed."""

    number: int
    sheet: int
    stroke: int | None
    width: float
    t: Array
    places: Array

    def until(self, t: float) -> int:
        """How many of its points are there at `t`."""
        return int(np.searchsorted(self.t, t, "right"))


Ink = tuple[tuple[Line, int], ...]
"""Lines and how many of their points are there already: ink as it is at some time."""


def printed(sheet: Sheet) -> list[Array]:
    """What is printed on a form: polylines (n, 2) in sheet coordinates. A frame, a grid,
    circles and rings of other sizes than are drawn, and rows of marks that look like text."""
    half = sheet.half - PRINT_EDGE_M
    frame = [_across(axis, side * half[axis], half) for axis in (0, 1) for side in (-1, 1)]
    grid = [
        _across(axis, float(at), half)
        for axis in (0, 1)
        for at in np.arange(-half[axis] + PRINT_GRID_M, half[axis], PRINT_GRID_M)
    ]
    rng = np.random.default_rng(0)
    spots = rng.uniform(-0.8, 0.8, (8, 2)) * half
    circles = [_circle(spot, r) for spot, r in zip(spots, np.linspace(4e-3, 45e-3, 8), strict=True)]
    return [*frame, *grid, *circles, *_text(half, rng)]


def _across(axis: int, at: float, half: Array) -> Array:
    ends = np.full((2, 2), at)
    ends[:, 1 - axis] = (-half[1 - axis], half[1 - axis])
    return ends


def _circle(centre: Array, radius: float) -> Array:
    angle = np.linspace(0.0, 2 * np.pi, 121)
    return centre + radius * np.column_stack([np.cos(angle), np.sin(angle)])


def _text(half: Array, rng: np.random.Generator) -> list[Array]:
    """Zigzags of a few millimetres, three rows below the upper edge."""
    marks = []
    for row in range(3):
        corner = np.array([-half[0] + 0.02, half[1] - 0.02 - 0.008 * row])
        for _ in range(14):
            steps = rng.uniform((0.4e-3, -2e-3), (1.6e-3, 2e-3), (5, 2))
            x = corner[0] + np.cumsum(steps[:, 0])
            marks.append(np.column_stack([x, corner[1] + steps[:, 1]]))
            corner[0] = x[-1] + 3e-3
    return marks


def _rotation(turn: float) -> Array:
    c, s = np.cos(turn), np.sin(turn)
    return np.array([[c, -s], [s, c]])
