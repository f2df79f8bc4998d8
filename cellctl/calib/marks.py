"""What went wrong with drawn circles, by name: slips of the pen, a wrong tip, radius or sheet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cellctl.calib.calibration import Calibration
from cellctl.calib.projector_map import homography_jacobian
from cellctl.calib.refine_fit import TCP_PRIOR_MM, Mark, Marks, rotations
from cellctl.geometry import Array

HUBER_MM = 0.4
SLIP_MM, SLIP_LIKELIHOOD, SLIP_SIGMAS = 1.0, 40.0, 5.0
"""A slip is reported from this size on, if twice the logarithm of the likelihood ratio and the
size in standard deviations exceed the other two. 40 with two unknowns is one in 10^8."""
SIDE, MOST_SLIPS = 3, 3
"""Circles on either side: fewer cannot be told from circles that are simply bad."""
TCP_MM, TCP_SIGMAS = 3.0, 2.0
RADIUS_SHARE, RADIUS_MM = 0.05, 0.5
SHEET_MM, SHEET_HUBER_MM = 0.5, 0.2
SWEEPS = 12


@dataclass(frozen=True, eq=False)
class Slip:
    """The pen moved by `mm` (2,), in tool axes at the drawing posture, between the circles
    `after` and `before`; `sigma_mm` is its standard deviation per axis."""

    after: str
    before: str
    mm: Array
    sigma_mm: float
    round_ended: int | None

    @property
    def reason(self) -> str:
        place = "" if self.round_ended is None else f" (after round {self.round_ended})"
        return (
            f"the pen slipped by {np.linalg.norm(self.mm):.1f} mm between {self.after} and "
            f"{self.before}{place}: clamp it, run `cellctl run tcp`, and draw again"
        )

    def to_dict(self) -> dict[str, Any]:
        return {
            "after": self.after,
            "before": self.before,
            "mm": self.mm.tolist(),
            "sigma_mm": self.sigma_mm,
            "round_ended": self.round_ended,
        }


def slips(marks: Sequence[Mark], base: Calibration) -> tuple[Slip, ...]:
    """Where the pen's offset in the tool changed; `marks` in the order in which they were drawn.

    What circles are off the chain is explained by an affine map (from 24 circles a projective
    one), the pen's offset, and a jump of it: every place for the jump is tried, with Huber's loss
    so that a bad circle makes no jump. Repeated with the jump found, for further ones.
    """
    if len(marks) < 2 * SIDE + 4:
        return ()
    drawn = Marks.of(marks, base)
    off = drawn.on_table_mm(drawn.seen) - 1e3 * drawn.xy
    columns = _smooth_columns(drawn)
    found: list[Slip] = []
    for _ in range(MOST_SLIPS):
        slip, jump = _strongest(marks, columns, drawn.turn + np.eye(2), off)
        if slip is None:
            break
        found.append(slip)
        columns = np.concatenate([columns, jump], axis=2)
    order = {mark.key: i for i, mark in enumerate(marks)}
    return tuple(sorted(found, key=lambda slip: order[slip.after]))


def slip_reasons(found: Sequence[Slip]) -> tuple[str, ...]:
    return tuple(slip.reason for slip in found)


def _smooth_columns(drawn: Marks) -> Array:
    """(n, 2, p): a map of the table, and the pen's constant offset in mm."""
    u = drawn.xy - drawn.xy.mean(axis=0)
    u = u / max(float(np.abs(u).max()), 1e-6)
    table = homography_jacobian(np.eye(3), u)[1][..., : 8 if len(drawn) >= 24 else 6]
    return np.concatenate([table, drawn.turn], axis=2)


def _strongest(
    marks: Sequence[Mark], columns: Array, turns: Array, off: Array
) -> tuple[Slip | None, Array]:
    """The likeliest slip, None if there is none, and its columns (n, 2, 2)."""
    places = np.arange(SIDE, len(marks) - SIDE + 1)
    jumps = (np.arange(len(marks)) >= places[:, None])[:, :, None, None] * turns
    every = np.concatenate([np.broadcast_to(columns, (len(places), *columns.shape)), jumps], axis=3)
    before = _robust(columns[None], off)[1]
    values, costs, covariance = _robust(every, off)
    best = int(np.argmin(costs))
    left = np.linalg.norm(off - every[best] @ values[best], axis=1)
    sigma = max(float(np.median(left)) / 1.1774, 0.02)
    mm, place = values[best, -2:], places[best]
    sigma_mm = sigma * float(np.sqrt(covariance[best, -2:, -2:].trace() / 2))
    size = float(np.linalg.norm(mm))
    likelihood = 2.0 * (before[0] - costs[best]) / sigma**2
    if size < SLIP_MM or likelihood < SLIP_LIKELIHOOD or size < SLIP_SIGMAS * sigma_mm:
        return None, jumps[best]
    one, other = marks[place - 1], marks[place]
    ended = one.round if one.round != other.round else None
    return Slip(one.key, other.key, mm, sigma_mm, ended), jumps[best]


def _robust(A: Array, y: Array) -> tuple[Array, Array, Array]:
    """Huber's loss of y (n, 2) on designs A (k, n, 2, p), each alone: values (k, p), costs (k,)
    and covariances (k, p, p) for unit noise. What nothing observes stays at zero: a prior of
    TCP_PRIOR_MM, in relation to HUBER_MM, is weak enough for the rest."""
    prior = (HUBER_MM / 2 / TCP_PRIOR_MM) ** 2 * np.eye(A.shape[-1])
    weights = np.ones(A.shape[:2])
    for _ in range(SWEEPS):
        weighted = A * weights[..., None, None]
        normal = np.einsum("knip,kniq->kpq", weighted, A, optimize=True) + prior
        right = np.einsum("knip,ni->kp", weighted, y, optimize=True)
        values = np.linalg.solve(normal, right[..., None])[..., 0]
        left = np.linalg.norm(y - np.einsum("knip,kp->kni", A, values), axis=2)
        weights = HUBER_MM / np.maximum(left, HUBER_MM)
    loss = np.where(left <= HUBER_MM, left**2 / 2, HUBER_MM * (left - HUBER_MM / 2))
    return values, loss.sum(axis=1), np.linalg.inv(normal)


def tcp_reasons(tcp_mm: Array, covariance_mm2: Array, limit_mm: float = TCP_MM) -> tuple[str, ...]:
    """A pen that stands further than the limit from where it is said to be. `tcp_mm` (2,) and
    its covariance are those of a RefineResult, in world axes at the drawing posture."""
    size = float(np.linalg.norm(tcp_mm))
    along = np.asarray(tcp_mm) / max(size, 1e-12)
    sigma = float(np.sqrt(along @ covariance_mm2 @ along))
    if size <= limit_mm + TCP_SIGMAS * sigma:
        return ()
    reason = (
        f"the pen stands {size:.1f} mm from where bracket.pen.tip_m says "
        f"({tcp_mm[0]:+.1f} mm along world x, {tcp_mm[1]:+.1f} mm along world y in the drawing "
        f"posture; limit {limit_mm:g} mm): run `cellctl run tcp` and correct the config"
    )
    return (reason,)


@dataclass(frozen=True)
class Radii:
    """Medians over the circles, millimetres."""

    commanded_mm: float
    measured_mm: float
    limit_mm: float

    @property
    def off_mm(self) -> float:
        return self.measured_mm - self.commanded_mm

    @property
    def reasons(self) -> tuple[str, ...]:
        if abs(self.off_mm) <= self.limit_mm:
            return ()
        reason = (
            f"circles come out with a radius of {self.measured_mm:.1f} mm instead of "
            f"{self.commanded_mm:.1f} mm: check the unit and the radius that the controller's "
            "program is given, and that the pen is clamped and upright"
        )
        return (reason,)


def radii(measured_mm: ArrayLike, commanded_mm: ArrayLike) -> Radii | None:
    """Measured radii beside those commanded, circle by circle; None when there is no circle.

    The median of their ratios is what counts, so that single bad circles do not. The limit is 5 %
    or half a millimetre, whichever is more.
    """
    measured, commanded = np.asarray(measured_mm), np.asarray(commanded_mm)
    if not len(measured):
        return None
    wanted, ratio = float(np.median(commanded)), float(np.median(measured / commanded))
    return Radii(wanted, ratio * wanted, max(RADIUS_SHARE * wanted, RADIUS_MM))


@dataclass(frozen=True, eq=False)
class Motion:
    """A sheet moved by `mm` at the middle of its circles and turned by `deg` between two
    pictures; `largest_mm` is the farthest that a circle went, `count` their number."""

    sheet: str
    before: str
    after: str
    mm: Array
    deg: float
    largest_mm: float
    count: int

    @property
    def reason(self) -> str:
        name = f"the sheet {self.sheet}" if self.sheet else "the sheet"
        return (
            f"{name} moved by {np.linalg.norm(self.mm):.1f} mm ({abs(self.deg):.1f} deg) between "
            f"{self.before} and {self.after}: fix it to the table and draw on a new one"
        )

    def to_dict(self) -> dict[str, Any]:
        return {
            "sheet": self.sheet,
            "before": self.before,
            "after": self.after,
            "mm": self.mm.tolist(),
            "deg": self.deg,
            "largest_mm": self.largest_mm,
            "circles": self.count,
        }


def sheet_motions(
    pictures: Sequence[tuple[str, Mapping[str, Array]]],
    sheets: Mapping[str, str] | None = None,
    limit_mm: float = SHEET_MM,
) -> tuple[Motion, ...]:
    """Motions beyond the limit between pictures, in the order in which they were taken.

    A picture is its name with the world places {circle: (2,)}, metres, of all circles that it
    shows, old ones too; `sheets` says on which sheet a circle is, when there are several. Each
    circle is compared with the picture before that shows it. One circle alone tells no motion.
    """
    found = []
    for i, (after, later) in enumerate(pictures):
        groups: dict[tuple[int, str], list[str]] = {}
        for key in later:
            seen = [j for j in range(i) if key in pictures[j][1]]
            if seen:
                groups.setdefault((seen[-1], (sheets or {}).get(key, "")), []).append(key)
        for (j, sheet), keys in sorted(groups.items()):
            before, earlier = pictures[j]
            places = [np.array([p[key] for key in keys]) for p in (earlier, later)]
            if len(keys) >= 2:
                found.append(_motion(sheet, before, after, places[0], places[1]))
    return tuple(motion for motion in found if motion.largest_mm > limit_mm)


def _motion(sheet: str, before: str, after: str, one: Array, two: Array) -> Motion:
    """The rigid motion from one (n, 2) to two (n, 2), Huber's weights: Kabsch 1976."""
    weights = np.ones(len(one))
    for _ in range(SWEEPS):
        middle, goal = (np.average(places, axis=0, weights=weights) for places in (one, two))
        angle = _angle(one - middle, two - goal, weights)
        moved = (one - middle) @ rotations(np.array([angle]))[0].T + goal
        left = 1e3 * np.linalg.norm(two - moved, axis=1)
        weights = SHEET_HUBER_MM / np.maximum(left, SHEET_HUBER_MM)
    farthest = 1e3 * float(np.linalg.norm(moved - one, axis=1).max())
    shift = 1e3 * (goal - middle)
    return Motion(sheet, before, after, shift, float(np.degrees(angle)), farthest, len(one))


def _angle(a: Array, b: Array, weights: Array) -> float:
    """By which a (n, 2) is to be turned to lie on b, both about their centres."""
    sine = weights @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    return float(np.arctan2(sine, weights @ (a * b).sum(axis=1)))
