"""Which correction the drawn circles ask for: fitted, held out in two ways, chosen, explained."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cellctl.calib.adjust import joint_family
from cellctl.calib.calibration import Calibration
from cellctl.calib.challenger import NAME as CHALLENGER
from cellctl.calib.challenger import challenger_family
from cellctl.calib.refine_fit import (
    FAMILIES,
    LARGEST_CONDITION,
    Family,
    Fit,
    Frame,
    Mark,
    Marks,
    condition,
    fit,
    held_out_fits,
)
from cellctl.calib.refine_result import Candidate, RefineResult
from cellctl.calib.views import Rejection, excess
from cellctl.errors import SolveError
from cellctl.geometry import Array, Mask

MINIMUM_MARKS = 4
JOINT_AFTER, CHALLENGER_AFTER = "similarity", "projective"
"""Where these stand among the families, which go from the simplest on."""
BANDS = 5
"""In which the marks' x, and their y, are cut: rows of a grid of up to five stay whole."""
UNDETERMINED = 1e3
"""A condition number."""
HUBER_MM = 0.4
OUTLIER_SIGMAS, OUTLIER_FLOOR_MM = 5.0, 0.6
LARGEST_REJECTED = 0.4


def solve_refine(
    marks: Sequence[Mark],
    base: Calibration,
    *,
    pose_covariance: Array | None = None,
    families: Sequence[str] | None = None,
) -> RefineResult:
    """The correction of `base` (whose own refinement is ignored) that predicts unseen circles
    best, and the pen's offset.

    Each family is judged by the worse of two held-out errors, everything being fitted again:
    without one circle, and without one row or column of them; see `choose`. Circles that
    contradict the others are left out of every fit and still get a held-out error.
    `pose_covariance` (6, 6), that of base's T_world_camera as in HandEyeResult, allows the joint
    adjustment. `families`: only these are tried. SolveError when fewer than 4 circles agree;
    BadInput as `Marks.of`.
    """
    base = replace(base, refinement=None)
    marks = sorted(marks, key=lambda mark: mark.key)
    drawn = Marks.of(marks, base)
    if len(drawn) < MINIMUM_MARKS:
        raise SolveError(f"only {len(drawn)} circles were measured, {MINIMUM_MARKS} are needed")
    frame = Frame.of(drawn)
    used = _consensus(drawn, frame)
    known = _families(drawn, used, frame, base, pose_covariance)
    wanted = [f for f in known if families is None or f.name in families]
    tried = [_candidate(family, drawn, used, frame, base) for family in wanted]
    chosen, why = choose([c for c in tried if c.fit is not None])
    assert chosen.fit is not None
    errors = chosen.fit.errors_mm(drawn)
    return RefineResult(
        refinement=chosen.fit.refinement,
        tcp_mm=1e3 * chosen.fit.tcp,
        tcp_covariance_mm2=_tcp_covariance(chosen.fit, errors[used]),
        chosen=chosen.name,
        why=why,
        candidates=tuple(tried),
        keys=drawn.keys,
        errors_mm=errors,
        errors_px=base.projector.project(chosen.fit.predict(drawn))
        - base.projector.project(drawn.seen),
        used=used,
        rejected=tuple(
            Rejection(
                drawn.keys[i], f"{np.linalg.norm(errors[i]):.1f} mm from where the others say"
            )
            for i in np.flatnonzero(~used)
        ),
        mark_sigma_mm=_sigma(chosen.fit, errors[used]),
        mark_freedom=chosen.fit.freedom,
    )


def _families(
    marks: Marks, used: Mask, frame: Frame, base: Calibration, pose_covariance: Array | None
) -> list[Family]:
    """All of them, from the simplest on."""
    more = {CHALLENGER_AFTER: challenger_family(marks[used], frame)}
    if pose_covariance is not None:
        more[JOINT_AFTER] = joint_family(base, pose_covariance, marks, frame)
    known = []
    for family in FAMILIES:
        known += [family, more[family.name]] if family.name in more else [family]
    return known


def choose(candidates: Sequence[Candidate]) -> tuple[Candidate, str]:
    """The candidate to trust and why, in words.

    The others come from the simplest on, and the first that the data cannot tell from the best one
    stands for them, see `views.excess`. The challenger is taken unless that one predicts circles
    left out one by one better, by more than chance does: it takes nothing on trust but the
    circles, and since its field is no larger than they ask for, it needs no row of them left out to
    keep it from bending between rows.
    """
    others = [c for c in candidates if c.name != CHALLENGER]
    challenger = next((c for c in candidates if c.name == CHALLENGER), None)
    if challenger is None:
        return _simplest(others)
    if not others:
        return challenger, "nothing else was tried"
    other, why = _simplest(others)
    one, two = (c.errors["leave_one_out"].mm for c in (challenger, other))
    if excess(challenger.left_one_out_mm, other.left_one_out_mm) > 0.0:
        return other, f"{why}; the circles alone, without hand-eye, reach {one:.3f} mm"
    return challenger, (
        f"held-out error {one:.3f} mm by the circles alone, without hand-eye; {other.name}, which "
        f"stands for the corrections of hand-eye's chain, reaches {two:.3f} mm"
    )


def _simplest(candidates: Sequence[Candidate]) -> tuple[Candidate, str]:
    best = min(candidates, key=lambda c: c.worse_mm)
    chosen = next(c for c in candidates if excess(c.held_out_mm, best.held_out_mm) <= 0.0)
    if chosen is best:
        return best, f"lowest held-out error, {best.worse_mm:.3f} mm"
    return chosen, (
        f"held-out error {chosen.worse_mm:.3f} mm; {best.name} reaches {best.worse_mm:.3f} mm, "
        "which is less than one standard error better"
    )


def _candidate(
    family: Family, marks: Marks, used: Mask, frame: Frame, base: Calibration
) -> Candidate:
    good = marks[used]
    number, ways = condition(family, good, frame), rows(good.xy)
    if len(good) < family.least:
        return Candidate(family.name, number, f"needs {family.least} circles, not {len(good)}")
    if number > LARGEST_CONDITION:
        why = f"the circles' places cannot determine it: condition number {number:.3g}"
        return Candidate(family.name, number, why)
    rests = [good[way != band] for way in ways for band in np.unique(way)]
    if max(condition(family, rest, frame) for rest in rests) > UNDETERMINED:
        why = "the circles' places do not determine it when a row of them is left out"
        return Candidate(family.name, number, why)
    found = fit(family, good, frame)
    predicted = {
        name: _held_out(family, marks, used, frame, found, folds)
        for name, folds in (("one", np.arange(len(good))[None]), ("row", ways))
    }
    return Candidate.measured(family.name, number, found, predicted, marks, used, base)


def rows(xy: Array) -> Array:
    """Bands (2, n) that marks at xy (n, 2) belong to: of x, and of y. Of equal width, so that a
    row of a regular layout is left out whole. Where all lie in one band, each mark is its own."""
    low, high = xy.min(axis=0), xy.max(axis=0)
    cell = (xy - low) / np.maximum(high - low, 1e-9) * BANDS
    bands = np.minimum(cell, BANDS - 1).astype(int).T
    return np.stack([way if np.ptp(way) else np.arange(len(xy)) for way in bands])


def _held_out(
    family: Family, marks: Marks, used: Mask, frame: Frame, found: Fit, folds: Array
) -> Array:
    """Predicted camera coordinates (n, 2, s) of all marks, each by fits without it; folds (s, n')
    number the folds of used marks in s ways. Marks not used are predicted by the whole fit."""
    predicted = np.repeat(found.predict(marks)[..., None], len(folds), axis=2)
    indices, good = np.flatnonzero(used), marks[used]
    for way, fold in enumerate(folds):
        for number, rest in held_out_fits(family, good, frame, found, fold):
            out = indices[fold == number]
            predicted[out, :, way] = rest.predict(marks[out])
    return predicted


def _consensus(marks: Marks, frame: Frame) -> Mask:
    """Which marks (n,) agree with what most of them say: robustly fitted, Huber's weights."""
    count = len(marks)
    family = max(
        (f for f in FAMILIES[:5] if f.least <= count and condition(f, marks, frame) < UNDETERMINED),
        key=lambda f: f.least,
    )
    weights, found = np.ones(count), None
    for _ in range(20):
        found = fit(family, marks, frame, start=found, weights=weights)
        off = np.linalg.norm(found.errors_mm(marks), axis=1)
        new = HUBER_MM / np.maximum(off, HUBER_MM)
        if np.abs(new - weights).max() < 1e-3:
            break
        weights = new
    sigma = float(np.median(off)) / 1.1774
    used = off < max(OUTLIER_SIGMAS * sigma, OUTLIER_FLOOR_MM)
    if used.sum() < max(MINIMUM_MARKS, (1 - LARGEST_REJECTED) * count):
        raise SolveError(
            f"only {used.sum()} of {count} circles agree with each other: did the pen, the sheet "
            "or the camera move between them?"
        )
    return used


def _sigma(found: Fit, errors: Array) -> float:
    """Standard deviation of a mark per axis, mm, from the fit's errors (n, 2)."""
    return float(np.sqrt(np.square(errors).sum() / max(found.freedom, 1.0)))


def _tcp_covariance(found: Fit, errors: Array) -> Array:
    """(2, 2) in square mm; the prior's where yaws tell nothing."""
    return np.linalg.inv(found.normal)[-2:, -2:] * max(_sigma(found, errors), 1e-3) ** 2
