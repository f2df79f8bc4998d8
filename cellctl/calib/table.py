"""The table's surface from points that the tool touched: a plane, and its bow if it shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from cellctl.calib.linear_fit import LinearFit, Noise, without_gross_errors
from cellctl.calib.table_surface import TERMS, Area, TableSurface, basis, numbers
from cellctl.calib.views import Rejection, excess
from cellctl.errors import BadInput, SolveError
from cellctl.geometry import Array

FEWEST, FEWEST_FOR_BOW = 3, 9
FLAT = Noise(0.5e-3, 8.0)
"""How far from a plane a sound table's points are, metres: what is within that is no outlier."""
BOWED = Noise(0.2e-3, 8.0)
"""The same about a bowed surface."""
OUTLIERS = 1.0 / 4.0
NARROW = 0.02
"""Touches that leave a line by less than that share of their spread lie on it."""
LEAST_SPREAD_M = 0.01
LEVELS = 0.15
"""A bow needs places in the middle as well as at both ends: least standard deviation of u^2."""


@dataclass(frozen=True)
class TableLimits:
    """What a table must reach to pass; the uncertainty is that of 95 %."""

    points: int = 6
    held_out_mm: float = 1.0
    uncertainty_mm: float = 2.0
    rejected: float = OUTLIERS


def solve_table(
    points: ArrayLike,
    *,
    area: Area | None = None,
    ids: Sequence[str] | None = None,
) -> TableSurface:
    """The surface through touched points (n, 3), metres in the world, n >= 3.

    A touch that contradicts the others, on a cable say, is left out and named. From nine points
    on, spread in both directions, a bow is fitted too where it predicts left-out touches better,
    by more than one standard error. `area` is where the surface is wanted, by default where it
    was touched. BadInput for what are no points, SolveError when they do not determine a plane.
    """
    places, names = _checked(points, ids)
    touched = Area(places[:, :2].min(axis=0), places[:, :2].max(axis=0))
    _refuse_narrow(places[:, :2])
    used = _trusted(places, touched)
    touched = Area(places[used, :2].min(axis=0), places[used, :2].max(axis=0))
    fits = {kind: _fit(places[used], touched, kind) for kind in _possible(places[used], touched)}
    kind = _choice(fits)
    fit = fits[kind]
    noise = FLAT if fit.spare == 0 else None
    surface = TableSurface(
        kind=kind,
        coefficients=fit.x,
        covariance=fit.variance(noise) * fit.inverse,
        spare=fit.spare,
        touched=touched,
        area=area or touched,
        rms_mm=1e3 * float(np.sqrt(np.mean(fit.residuals**2))),
        held_out_mm={k: 1e3 * float(np.sqrt(np.mean(f.held_out**2))) for k, f in fits.items()},
        used=tuple(names[i] for i in used),
        rejected=(),
    )
    return _with_rejections(surface, places, names, used)


def judge(surface: TableSurface, limits: TableLimits | None = None) -> tuple[str, tuple[str, ...]]:
    """("pass" or "fail", reasons in words); a pass has no reasons."""
    limits = limits or TableLimits()
    reasons = []
    used, rejected = len(surface.used), len(surface.rejected)
    if used < limits.points:
        reasons.append(f"only {used} touches could be used; at least {limits.points} are needed")
    if rejected > limits.rejected * (used + rejected):
        reasons.append(f"{rejected} of {used + rejected} touches were rejected")
    held_out = surface.held_out_mm[surface.kind]
    if used > FEWEST and not held_out <= limits.held_out_mm:
        reasons.append(
            f"held-out error {held_out:.2f} mm, over the limit of {limits.held_out_mm:g} mm: the "
            "table is not flat, or a touch was on something that lies on it"
        )
    uncertainty = 1e3 * surface.uncertainty_m
    if not uncertainty <= limits.uncertainty_mm:
        reasons.append(
            f"the table's height is known to {uncertainty:.2f} mm (95 %) where it is known worst, "
            f"over the limit of {limits.uncertainty_mm:g} mm: add touches near the area's edges"
        )
    return ("fail" if reasons else "pass"), tuple(reasons)


def _fit(points: Array, touched: Area, kind: str) -> LinearFit:
    return LinearFit.of(basis(points[:, :2], touched, kind)[:, None], points[:, 2:])


def _possible(points: Array, touched: Area) -> list[str]:
    """The kinds that the points can tell."""
    if len(points) < FEWEST_FOR_BOW:
        return ["plane"]
    design = basis(points[:, :2], touched, "bow and twist")
    spread = np.linalg.svd(design[:, 1:] - design[:, 1:].mean(axis=0), compute_uv=False)
    return list(TERMS) if spread[-1] / np.sqrt(len(points)) > LEVELS else ["plane"]


def _trusted(points: Array, touched: Area) -> Array:
    """Numbers of the points that are no outliers of the most flexible surface possible."""
    kind = _possible(points, touched)[-1]
    design = basis(points[:, :2], touched, kind)[:, None]
    noise = FLAT if kind == "plane" else BOWED
    most = int(OUTLIERS * len(points))
    _, used = without_gross_errors(design, points[:, 2:], noise, least=TERMS[kind] + 1, most=most)
    return used


def _choice(fits: dict[str, LinearFit]) -> str:
    """The simplest kind that predicts left-out touches as well as the best."""
    tried = {k: fit for k, fit in fits.items() if k == "plane" or np.isfinite(fit.held_out).all()}
    best = min(tried, key=lambda kind: float(np.square(tried[kind].held_out).sum()))
    if best == "plane":
        return best
    squares = list(tried[best].held_out)
    good = (k for k, fit in tried.items() if k == best or excess(list(fit.held_out), squares) <= 0)
    return next(good)


def _with_rejections(
    surface: TableSurface, points: Array, names: list[str], used: Array
) -> TableSurface:
    left_out = np.setdiff1d(np.arange(len(points)), used)
    off = points[left_out, 2] - surface.height(points[left_out, :2])
    reason = "it is {:.1f} mm {} the surface on which the others agree"
    rejected = tuple(
        Rejection(names[i], reason.format(1e3 * abs(gap), "above" if gap > 0 else "below"))
        for i, gap in zip(left_out, off, strict=True)
    )
    return replace(surface, rejected=rejected)


def _refuse_narrow(places: Array) -> None:
    """SolveError when touches (n, 2) lie in one place or on one line."""
    centred = places - places.mean(axis=0)
    along, across = np.linalg.svd(centred, compute_uv=False)[:2] / np.sqrt(len(places))
    if along < LEAST_SPREAD_M:
        raise SolveError(
            f"all touches lie within {2e3 * along:.0f} mm: touch the table all over the area"
        )
    if across < NARROW * along:
        raise SolveError("the touches lie on a line: touch the table off that line as well")


def _checked(points: ArrayLike, ids: Sequence[str] | None) -> tuple[Array, list[str]]:
    places = numbers(points, "touches", (None, 3))
    names = [str(i + 1) for i in range(len(places))] if ids is None else list(ids)
    if len(names) != len(places) or len(set(names)) < len(names):
        raise BadInput(f"{len(places)} touches need {len(places)} different ids, not {names}")
    if len(places) < FEWEST:
        raise SolveError(f"{len(places)} touches do not make a plane; at least {FEWEST} are needed")
    return places, names
