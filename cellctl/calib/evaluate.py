"""How good a calibration is, by circles that no fit has seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import fdtri, gammaincinv

from cellctl.calib.views import rms
from cellctl.errors import SolveError
from cellctl.geometry import Array

RATE = 0.95
MINIMUM_CIRCLES = 4


@dataclass(frozen=True, eq=False)
class Evaluation:
    """`held_out_px`, `held_out_mm`: e_RMSE between projected and drawn centres,
    sqrt(mean(dx^2 + dy^2)), Eq. (9) of the paper; it holds the calibration's own error and the
    noise of drawing. `own_mm` is the best guess at the former alone.

    `held_out_ci_mm` and `held_out_ci_px` hold, at RATE or more, the calibration's own error: the
    root mean square that it would have over the whole area, drawn without noise. They hold
    `held_out_mm` as well. See `interval`.
    """

    keys: tuple[str, ...]
    differences_px: Array
    differences_mm: Array
    held_out_px: float
    held_out_mm: float
    held_out_ci_px: tuple[float, float]
    held_out_ci_mm: tuple[float, float]
    own_mm: float
    mark_sigma_mm: float

    @property
    def meaning(self) -> str:
        """What the figures say, in words."""
        low, high = self.held_out_ci_mm
        return (
            f"{len(self.keys)} circles that no fit has seen were drawn {self.held_out_mm:.2f} mm "
            "(root mean square) from where the projector shows them. "
            f"Drawing itself scatters by {np.sqrt(2) * self.mark_sigma_mm:.2f} mm, so that the "
            f"calibration's own share is about {self.own_mm:.2f} mm; at {100 * RATE:.0f} % "
            f"confidence it is between {low:.2f} mm (all scatter taken out) and {high:.2f} mm "
            "(none taken out)"
        )

    def to_dict(self) -> dict[str, Any]:
        rows = zip(self.keys, self.differences_px, self.differences_mm, strict=True)
        return {
            "circles": len(self.keys),
            "held_out_px": self.held_out_px,
            "held_out_mm": self.held_out_mm,
            "held_out_ci_px": list(self.held_out_ci_px),
            "held_out_ci_mm": list(self.held_out_ci_mm),
            "own_mm": self.own_mm,
            "mark_sigma_mm": self.mark_sigma_mm,
            "meaning": self.meaning,
            "per_circle": {key: {"px": px.tolist(), "mm": mm.tolist()} for key, px, mm in rows},
        }


def evaluate(
    keys: Sequence[str],
    differences_px: Array,
    differences_mm: Array,
    *,
    mark_sigma_mm: float,
    mark_freedom: float,
) -> Evaluation:
    """From the differences (n, 2) between projected and drawn centres, in projector pixels and in
    millimetres on the table, and from the noise of a mark per axis, known with `mark_freedom`
    degrees of freedom. SolveError for fewer than 4 circles or a difference that is not finite."""
    if len(keys) < MINIMUM_CIRCLES:
        raise SolveError(f"only {len(keys)} circles to evaluate with, {MINIMUM_CIRCLES} are needed")
    for key, px, mm in zip(keys, differences_px, differences_mm, strict=True):
        if not np.isfinite([*px, *mm]).all():
            raise SolveError(f"the circle {key!r} lies where the calibration has no inverse")
    total_px, total_mm = rms(differences_px), rms(differences_mm)
    ends = interval(total_mm, len(keys), mark_sigma_mm, mark_freedom)
    px = total_px / max(total_mm, 1e-12)
    return Evaluation(
        keys=tuple(keys),
        differences_px=np.asarray(differences_px, dtype=float),
        differences_mm=np.asarray(differences_mm, dtype=float),
        held_out_px=total_px,
        held_out_mm=total_mm,
        held_out_ci_px=(px * ends[0], px * ends[1]),
        held_out_ci_mm=ends,
        own_mm=float(np.sqrt(max(total_mm**2 - 2 * mark_sigma_mm**2, 0.0))),
        mark_sigma_mm=mark_sigma_mm,
    )


def interval(
    total: float, count: int, sigma: float, freedom: float, rate: float = RATE
) -> tuple[float, float]:
    """Both ends for the calibration's own RMS error, from the RMS `total` at `count` circles.

    A difference is the calibration's error at that place, of variance v per axis over the area,
    plus a mark's noise, of a variance that is estimated as `sigma`^2 with `freedom` degrees of
    freedom. Then (total^2 / 2) / ((1 + v / s^2) sigma^2) follows Fisher's F with 2 count and
    `freedom`: the lower end is sqrt(2 v) at its upper quantile, all noise taken out. A bound that
    takes the places as fixed (the noncentral F) would be nearer, but would forget that other
    places have other errors. The upper end takes no noise out: total^2 2 count over the lower
    quantile of chi-square. So the interval also holds `total`, and more than `rate` of the own
    errors. Searle, Casella, McCulloch, Variance components, 1992, section 3.6.
    """
    tail = (1.0 - rate) / 2.0
    ratio = total**2 / 2.0 / max(sigma, 1e-12) ** 2
    excess = ratio / fdtri(2 * count, max(freedom, 1.0), 1.0 - tail) - 1.0
    low = sigma * np.sqrt(2.0 * max(excess, 0.0))
    high = total * np.sqrt(2 * count / (2.0 * gammaincinv(count, tail)))
    return float(low), float(high)
