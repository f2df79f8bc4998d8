"""Which observations to make next: those after which the predicted error is smallest.

An observation is a block of rows X (r, p), derivatives by p parameters in standard deviations of
its noise. With the information M of all that is known, C = M^-1, and with the derivatives J of what
is wanted, over a grid of places, the mean predicted variance is tr(W C), W the mean of J^T J:
I-optimality, Atkinson, Donev and Tobias, Optimum experimental designs, 2007, section 10.6. Another
block lowers it by tr((I + X C X^T)^-1 X C W C X^T) (Woodbury), which is worked out for all
candidates at once; the best is taken, and so on. Greedy, so that every beginning of the list is as
good as it can be, and collecting may stop anywhere.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cellctl.calib.projector_map import homography_jacobian
from cellctl.calib.refine_fit import MARK_SIGMA_MM, TCP_PRIOR_MM, rotations
from cellctl.calib.refinement import monomials
from cellctl.calib.table_surface import Area
from cellctl.geometry import Array, Mask

FALL = 0.05
"""A round that lowers the predicted error by less than this part is the last."""
APART = 0.4
BEYOND = 1.1
"""Times the area, light is wanted over it too."""
MAP_MM, FIELD_MM, FIELD_TERMS = 5.0, 0.15, 7
"""Standard deviations, millimetres at the edge of the area, of what hand-eye and table leave, and
of the smooth field of second and third degree: see `challenger`, and what it finds."""


class Design:
    """What is known (information (p, p)), and of what it is wanted: `interest` (g, q, p)."""

    def __init__(self, information: Array, interest: Array) -> None:
        self._covariance = np.linalg.inv(information)
        flat = interest.reshape(-1, interest.shape[-1])
        self._wanted = flat.T @ flat / len(interest)

    @property
    def error(self) -> float:
        """Root mean square over the grid of the predicted error, in the units of `interest`."""
        return float(np.sqrt(np.trace(self._wanted @ self._covariance)))

    def gains(self, rows: Array) -> Array:
        """By how much each candidate of rows (m, r, p) would lower the mean variance: (m,)."""
        XC = rows @ self._covariance
        inner = XC @ np.swapaxes(rows, 1, 2) + np.eye(rows.shape[1])
        gained = XC @ self._wanted @ np.swapaxes(XC, 1, 2)
        return np.trace(np.linalg.solve(inner, gained), axis1=1, axis2=2)

    def add(self, row: Array) -> None:
        """The observation (r, p) is made."""
        XC = row @ self._covariance
        inner = XC @ row.T + np.eye(len(row))
        self._covariance = self._covariance - XC.T @ np.linalg.solve(inner, XC)


def greedy(design: Design, rows: Array, count: int, blocked: Mask | None = None) -> list[int]:
    """Up to `count` of the candidates rows (m, r, p), best first; each once. `blocked` (m, m):
    whether taking one forbids the other. What is taken is added to `design`."""
    free = np.ones(len(rows), bool)
    chosen: list[int] = []
    while len(chosen) < count and free.any():
        best = int(np.argmax(np.where(free, design.gains(rows), -np.inf)))
        chosen.append(best)
        design.add(rows[best])
        free[best] = False
        if blocked is not None:
            free &= ~blocked[best]
    return chosen


def enough(errors: Sequence[float], wanted: float, fall: float = FALL) -> str:
    """Why to stop collecting, empty when not to: `errors` are the predicted ones after each round,
    in millimetres, not-a-number where there was none yet."""
    if not errors or not np.isfinite(errors[-1]):
        return ""
    if errors[-1] <= wanted:
        return f"the predicted error, {errors[-1]:.3f} mm, is not above the wanted {wanted:.3f} mm"
    if len(errors) > 1 and errors[-1] > (1.0 - fall) * errors[-2]:
        return (
            f"the predicted error no longer falls: {errors[-1]:.3f} mm after {errors[-2]:.3f} mm; "
            f"{wanted:.3f} mm is not to be had by more circles"
        )
    return ""


def circle_rows(xy: Array, yaw: Array, low: Array, high: Array) -> Array:
    """Rows (n, 2, 24) of circles at world places xy (n, 2) with the tool turned by yaw (n,), when
    robot to camera is the challenger's map over the area from `low` to `high` (2,), metres. Its
    parameters are millimetres: a homography's eight, a field's fourteen, the pen's offset."""
    u = (xy - (low + high) / 2) / (np.max(high - low) / 2)
    of_map = homography_jacobian(np.eye(3), u)[1]
    field = monomials(u, FIELD_TERMS)[:, None, :, None] * np.eye(2)[:, None, :]
    of_pen = rotations(yaw) - np.eye(2)
    rows = np.concatenate([of_map, field.reshape(len(u), 2, -1), of_pen], axis=2)
    return rows / MARK_SIGMA_MM


def choose_circles(xy: Array, low: Array, high: Array, count: int, spacing: float) -> list[int]:
    """Up to `count` of the places xy (n, 2), metres, best first, in the area from `low` to `high`.

    The tool's yaw is left to the caller: a choice that looked at it would take places where the
    tool cannot be turned, since there the pen's offset does no harm, and would never learn it. No
    two lie nearer than `spacing` metres; and as long as there is room none nearer than APART of the
    side of the square that is each circle's share of the area: the smooth map is only a model, and
    circles far apart show where it is not right.
    """
    beyond = (BEYOND - 1.0) / 2 * (high - low)
    design = circle_design(Area(low - beyond, high + beyond).grid(), low, high)
    share = APART * float(np.sqrt(np.prod(high - low) / max(count, 1)))
    rows = circle_rows(xy, np.zeros(len(xy)), low, high)
    away, chosen = np.full(len(xy), np.inf), list[int]()
    while len(chosen) < count and (away >= spacing).any():
        apart = away >= max(share, spacing)
        free = np.flatnonzero(apart if apart.any() else away >= spacing)
        best = free[int(np.argmax(design.gains(rows[free])))]
        design.add(rows[best])
        chosen.append(int(best))
        away = np.minimum(away, np.linalg.norm(xy - xy[best], axis=1))
        away[best] = -np.inf
    return chosen


def circle_design(places: Array, low: Array, high: Array) -> Design:
    """Before any circle is drawn: the error of the map, in mm, at world places (g, 2) is wanted, in
    the drawing posture."""
    sigmas = np.concatenate(
        [np.full(8, MAP_MM), np.full(2 * FIELD_TERMS, FIELD_MM), np.full(2, TCP_PRIOR_MM)]
    )
    interest = MARK_SIGMA_MM * circle_rows(places, np.zeros(len(places)), low, high)
    return Design(np.diag(sigmas**-2.0), interest)
