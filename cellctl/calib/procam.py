"""A projector's full model, and the camera's, from captures of a lit board.

A capture is a board as camera and projector have it (procam_fit.Capture). All are adjusted
together; held out is one capture at a time: all is fitted without it, its board's pose is then
fitted to the camera's corners alone, and the projector's pixels are predicted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cellctl.calib.camera import INTRINSICS, CameraModel
from cellctl.calib.procam_fit import OPTIONS, ProcamFit, belonging
from cellctl.calib.procam_problem import Capture, Noise
from cellctl.calib.procam_screen import half_turned, screened
from cellctl.calib.views import Rejection, excess, rms
from cellctl.errors import SolveError
from cellctl.geometry import Array

MINIMUM_CAPTURES = 2
"""Fewer fix no projector; of two, none can be held out."""


@dataclass(frozen=True, eq=False)
class CaptureFit:
    """A capture in the solution: T_camera_board (4, 4); errors in projector px, and in camera
    px."""

    id: str
    pose: Array
    rms_px: float
    camera_rms_px: float
    held_out_px: float


@dataclass(frozen=True, eq=False)
class ProcamResult:
    """`pose` is T_projector_camera (4, 4). Errors are in projector pixels unless they say
    camera. `held_out_px` counts every capture that could be read, `held_out_used_px` those that
    the fit rests on; not-a-number of two captures. `camera_sigma` and `projector_sigma` (9,) are
    standard deviations in the order of INTRINSICS."""

    camera: CameraModel
    projector: CameraModel
    pose: Array
    camera_sigma: Array
    projector_sigma: Array
    rms_px: float
    camera_rms_px: float
    held_out_px: float
    held_out_used_px: float
    captures: tuple[CaptureFit, ...]
    rejected: tuple[Rejection, ...]
    warp: Array
    noise: Noise
    half_turned: bool

    @property
    def used(self) -> list[str]:
        return [capture.id for capture in self.captures]

    def to_dict(self) -> dict[str, Any]:
        """JSON form, as `cellctl solve --json` prints it."""
        projector = self.projector.to_dict()
        return {
            "views": {"used": self.used, "rejected": [r.to_dict() for r in self.rejected]},
            "rms_px": self.rms_px,
            "camera_rms_px": self.camera_rms_px,
            "held_out_px": _told(self.held_out_px),
            "held_out_used_px": _told(self.held_out_used_px),
            "camera": self.camera.to_dict(),
            "camera_sigma": dict(zip(INTRINSICS, self.camera_sigma.tolist(), strict=True)),
            "projector": {
                "K": projector["K"],
                "distortion": projector["distortion"],
                "size": projector["image_size"],
            },
            "projector_sigma": dict(zip(INTRINSICS, self.projector_sigma.tolist(), strict=True)),
            "T_projector_camera": self.pose.tolist(),
            "board_warp_m": self.warp.tolist(),
            "noise": {
                "corner_camera_px": self.noise.camera,
                "reading_projector_px": self.noise.projector,
                "bulge_m": self.noise.lift,
            },
            "per_view_px": {
                c.id: {
                    "rms": c.rms_px,
                    "camera_rms": c.camera_rms_px,
                    "held_out": _told(c.held_out_px),
                }
                for c in self.captures
            },
            "remarks": [HALF_TURN] if self.half_turned else [],
        }


HALF_TURN = (
    "the camera sees the projector's picture upside down, by half a turn: if it does not hang so, "
    "the projector is in ceiling mode"
)


def _told(number: float) -> float | None:
    """JSON knows no not-a-number."""
    return number if np.isfinite(number) else None


@dataclass(frozen=True)
class ProcamLimits:
    """What a projector must reach to pass; `focal_sigma` is relative to the focal length."""

    captures: int = 3
    held_out_px: float = 1.0
    focal_sigma: float = 0.03
    rejected: float = 1.0 / 3.0


def judge(result: ProcamResult, limits: ProcamLimits | None = None) -> tuple[str, tuple[str, ...]]:
    """("pass" or "fail", reasons in words); a pass has no reasons."""
    limits = limits or ProcamLimits()
    reasons = []
    used, rejected, held_out = len(result.used), result.rejected, result.held_out_used_px
    named = "; ".join(f"{r.id}: {r.reason}" for r in rejected[:5])
    if used < limits.captures:
        reasons.append(
            f"only {used} captures could be used; at least {limits.captures} are needed, to hold "
            "one out" + (f" ({named})" if named else "")
        )
    if len(rejected) > limits.rejected * (used + len(rejected)):
        reasons.append(f"{len(rejected)} of {used + len(rejected)} captures were rejected: {named}")
    if held_out > limits.held_out_px:
        reasons.append(
            f"held-out error {held_out:.2f} projector px, over the limit of "
            f"{limits.held_out_px} px: take more captures, with the board flat and unmoved"
        )
    sigma = float((result.projector_sigma[:2] / result.projector.vector[:2]).max())
    if not sigma <= limits.focal_sigma:
        reasons.append(
            f"the projector's focal length is known to {100 * sigma:.1f} % only, limit "
            f"{100 * limits.focal_sigma:.0f} %: take captures with the board tilted by 20 to 45 "
            "degrees in different ways, near and far"
        )
    return ("fail" if reasons else "pass"), tuple(reasons)


def solve_procam(
    captures: Sequence[Capture],
    image_size: tuple[int, int],
    size: tuple[int, int],
    seen: dict[str, int] | None = None,
) -> ProcamResult:
    """Camera and projector from captures; `size` (w, h) is the projector's. `seen`: how many
    corners the camera saw in each, by id, where fewer could be read.

    Whether the board is bent is decided by the held-out error. SolveError when the captures are
    too few, mirrored, or all alike.
    """
    captures = sorted(captures, key=lambda capture: capture.id)
    usable, rejected = screened(captures, {c.id: len(c.points) for c in captures} | (seen or {}))
    _require(usable, rejected)
    start, strangers = belonging(usable, image_size, size)
    rejected = sorted([*rejected, *strangers], key=lambda rejection: rejection.id)
    _require(start.captures, rejected)
    fit, held_out = _chosen(start)
    return _result(fit, captures, held_out, rejected)


def _chosen(start: ProcamFit) -> tuple[ProcamFit, list[Array]]:
    """The simplest option that is as good as the best, see `excess`, and its held-out errors,
    capture by capture; of two captures there are none, and boards are rather bent than not."""
    if len(start.captures) <= MINIMUM_CAPTURES:
        return start.adjusted(OPTIONS[-1]), [np.full((1, 2), np.nan) for _ in start.captures]
    fits = [start.adjusted(option) for option in OPTIONS]
    held_out = [fit.held_out(fit.captures) for fit in fits]
    best = min(held_out, key=lambda errors: rms(np.concatenate(errors)))
    chosen = next(i for i, errors in enumerate(held_out) if excess(errors, best) <= 0)
    return fits[chosen], held_out[chosen]


def _held_out_of_all(
    fit: ProcamFit, captures: Sequence[Capture], held_out: Sequence[Array]
) -> float:
    """Of all captures that could be read, with all their points."""
    if not np.isfinite(np.concatenate(held_out)).all():
        return float("nan")
    return rms(np.concatenate(fit.held_out(captures)))


def _require(captures: Sequence[Capture], rejected: Sequence[Rejection]) -> None:
    if len(captures) < MINIMUM_CAPTURES:
        why = "".join(f"; {r.id}: {r.reason}" for r in rejected[:5])
        raise SolveError(
            f"{len(captures)} usable captures; a projector needs at least {MINIMUM_CAPTURES}, the "
            f"board tilted in different ways{why}",
            rejected=[rejection.to_dict() for rejection in rejected],
        )


def _result(
    fit: ProcamFit,
    captures: Sequence[Capture],
    held_out: Sequence[Array],
    rejected: Sequence[Rejection],
) -> ProcamResult:
    """`captures` are all that could be read; `held_out` the errors of those that were used."""
    camera, projector = fit.errors()
    names = [capture.id for capture in fit.captures]
    camera_sigma, projector_sigma = fit.sigmas()
    return ProcamResult(
        camera=fit.state.camera,
        projector=fit.state.projector,
        pose=fit.state.pose,
        camera_sigma=camera_sigma,
        projector_sigma=projector_sigma,
        rms_px=rms(np.concatenate(projector)),
        camera_rms_px=rms(np.concatenate(camera)),
        held_out_px=_held_out_of_all(fit, captures, held_out),
        held_out_used_px=rms(np.concatenate(held_out)),
        captures=tuple(
            CaptureFit(name, fit.state.boards[i], rms(projector[i]), rms(camera[i]), rms(held))
            for i, (name, held) in enumerate(zip(names, held_out, strict=True))
        ),
        rejected=tuple(rejected),
        warp=fit.state.warp,
        noise=fit.noise,
        half_turned=half_turned(fit.captures),
    )
