"""What all observations of a run say together: the joint adjustment, the error to expect over the
table, where it comes from, and what would lower it."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cellctl.calib.calibration import Calibration
from cellctl.calib.compare import gaps
from cellctl.calib.joint import uncertainty
from cellctl.calib.joint.observations import BoardViews, Circles, Lit, LitBoard, Observations
from cellctl.calib.joint.result import JointResult
from cellctl.calib.joint.solve import solve_joint
from cellctl.calib.joint.uncertainty import Step
from cellctl.calib.refine import Adjust, solve_refine
from cellctl.calib.refine_fit import Mark
from cellctl.calib.views import RobotView
from cellctl.config import CellConfig
from cellctl.errors import SolveError
from cellctl.geometry import Array
from cellctl.procedures import hand_eye, intrinsic, lit_board, refine
from cellctl.procedures.evaluate import Judged
from cellctl.procedures.knowledge import board_of
from cellctl.procedures.observations import journalled
from cellctl.procedures.optical import Optical
from cellctl.procedures.record import Record
from cellctl.procedures.spots import area

CAMERA, HAND_EYE, HELD = "intrinsic views", "hand-eye views", "held boards"
NAMES = {CAMERA: "camera", HAND_EYE: "hand-eye"}
"""Of groups of views, as sources of error."""
MORE = {
    "circles": "draw {n} circles more",
    "markers": "project {n} markers more",
    "touches": "touch the table {n} times more",
    CAMERA: "take {n} views of the checkerboard more",
    HAND_EYE: "take {n} views of the marker board more",
    "lit boards": "hold the marker board into the light {n} times more",
}
GRID, REACH = 11, 1.1
"""The map: so many places in each direction, over that part of the drawn area."""
QUICK = ("none", "shift", "similarity", "affine", "projective", "quadratic")
"""Families with which it is tried how far fewer circles lead."""
DOZEN, LEVEL = 12, 0.05
"""Data are enough when a dozen circles more lower the predicted error by less than that part."""
FEWEST = 6


@dataclass(frozen=True, eq=False)
class HeldBoard:
    """The marker board as it was held into the light, and the light that was read on it."""

    view: RobotView
    light: Lit


def held_boards(record: Record[Any]) -> list[HeldBoard]:
    """Those of a projector's run, or part of a run."""
    board, found = board_of(record.config, hand_eye.BOARD), []
    for _, sample in sorted(record.samples(lit_board.LIT).items()):
        view = None if sample.data["flaw"] else journalled(sample, board)
        if isinstance(view, RobotView):
            data = sample.data
            light = Lit(np.array(data["projector_px"]), np.array(data["camera_px"]))
            found.append(HeldBoard(view, light))
    return found


def observations(
    optical: Optical, touches: Array, marks: Sequence[Mark], held: Sequence[HeldBoard] = ()
) -> Observations:
    """All that a run saw; `touches` (n, 3) of the table, metres in the world."""
    rejected = {r.id for r in (*optical.camera.rejected, *optical.pose.rejected)}
    light = [
        (optical.shown.centres[number], pixel)
        for picture in optical.shown.pictures
        for number, pixel in picture.items()
    ]
    views = [
        BoardViews(CAMERA, intrinsic.BOARD, _kept(optical.checker.views, rejected)),
        BoardViews(HAND_EYE, hand_eye.BOARD, _kept(optical.markers.views, rejected)),
    ]
    if held:
        views.append(BoardViews(HELD, hand_eye.BOARD, [one.view for one in held]))
    return Observations(
        views=views,
        lit_boards=[LitBoard(HELD, one.view.id, one.light) for one in held],
        touches=touches,
        markers=Lit(np.array([p for p, _ in light]), np.array([c for _, c in light])),
        circles=Circles.of(marks, optical.camera.camera),
    )


def _kept(views: Sequence[RobotView], rejected: set[str]) -> list[RobotView]:
    return [view for view in views if view.id not in rejected]


def adjusting(
    optical: Optical, touches: Array, held: Sequence[HeldBoard], base: Calibration
) -> Adjust:
    """The joint adjustment of a run, from `base`, with those circles that agree."""

    def adjust(marks: Sequence[Mark]) -> JointResult:
        return solve_joint(observations(optical, touches, marks, held), base)

    return adjust


def places(config: CellConfig) -> Array:
    """The world points (GRID^2, 2), metres, at which errors are predicted."""
    low, high = area(config)
    middle, half = (low + high) / 2, REACH * (high - low) / 2
    sides = [np.linspace(m - h, m + h, GRID) for m, h in zip(middle, half, strict=True)]
    return np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)


def told(result: JointResult, points: Array) -> dict[str, Any]:
    """The JSON form of what is predicted over `points` (n, 2): `predicted_mm`, `map`, `budget`,
    `next`, `curve`, and `enough`, a sentence."""
    found = uncertainty.error_map(result, points)
    counts = {kind: len(units) for kind, units in uncertainty.data(result).items()}
    drawn = counts.get("circles", 0)
    steps = uncertainty.curve(result, points, "circles", _counts(drawn)) if drawn else []
    return {
        "predicted_mm": found.rms_mm,
        "map": {"places": np.column_stack([points, found.sigma_mm]).tolist()},
        "budget": [
            {"source": NAMES.get(source, source), "rms_mm": rms}
            for source, rms in found.budget_mm.items()
        ],
        "next": [
            {"do": MORE[kind].format(n=counts[kind]), "predicted_mm": rms}
            for kind, rms in uncertainty.what_next(result, points).items()
            if kind in MORE
        ],
        "curve": [
            {"circles": step.count, "predicted_mm": step.rms_mm}
            for step in steps
            if np.isfinite(step.rms_mm)
        ],
        "enough": _enough(steps),
        "projector": _projector(result),
        "sigma": {name: float(sigma) for name, sigma in result.sigma.items()},
    }


def _projector(result: JointResult) -> dict[str, Any] | None:
    """The projector's full model in the world, once a second plane was lit."""
    if not result.seen.lit_boards:
        return None
    full = result.state.full_projector
    lens = full.lens.to_dict()
    return {
        "K": lens["K"],
        "distortion": lens["distortion"],
        "T_world_projector": full.pose.tolist(),
    }


def _counts(drawn: int) -> list[int]:
    """Whole dozens, half a dozen, and all."""
    return sorted({min(n, drawn) for n in (FEWEST, *range(DOZEN, drawn + DOZEN, DOZEN))})


def _enough(steps: Sequence[Step]) -> str:
    """From which number of circles on more of them hardly help."""
    whole = [step for step in steps if step.count % DOZEN == 0]
    for before, after in itertools.pairwise(whole):
        if after.rms_mm > (1.0 - LEVEL) * before.rms_mm:
            return f"After {before.count} circles a dozen more gain less than {LEVEL:.0%}."
    if not whole:
        return ""
    return f"With {whole[-1].count} circles the error still falls: more of them would help."


def learning(
    marks: Sequence[Mark], unseen: Judged, base: Calibration, best: Calibration
) -> dict[int, float]:
    """Error in mm, rms, on circles that no fit has seen, by the number of circles that a fit to
    the first of `marks`, in the order of drawing, may use."""
    tcp_mm = np.array(best.quality.get("tcp_off_mm", (0.0, 0.0)))
    found = {}
    for count in _counts(len(marks)):
        try:
            found_with = solve_refine(marks[:count], base, families=QUICK)
        except SolveError:
            continue
        fitted = refine.refined(base, found_with)
        found[count] = gaps(fitted, unseen.marks, best, tcp_mm).rms_mm
    return found


def with_learning(data: dict[str, Any], held_out: dict[int, float]) -> dict[str, Any]:
    """`told` with the measured curve beside the predicted one."""
    curve = [
        {**step, "held_out_mm": held_out[step["circles"]]} if step["circles"] in held_out else step
        for step in data["curve"]
    ]
    return {**data, "curve": curve}
