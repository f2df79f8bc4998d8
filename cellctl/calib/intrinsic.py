"""Camera intrinsics from views of a flat board (Zhang, 2000), with leave-one-out held-out error."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from cellctl.calib.camera import INTRINSICS, CameraModel
from cellctl.calib.camera_fit import MINIMUM_POINTS, CameraFit, CameraOption, fit_camera
from cellctl.calib.chain import Chain, ChainState, Free, Sheet
from cellctl.calib.pose import board_pose
from cellctl.calib.schur import minimise
from cellctl.calib.views import Batch, Rejection, View, excess, ordered, rms, shortage
from cellctl.errors import SolveError
from cellctl.geometry import Array


@dataclass(frozen=True, eq=False)
class ViewFit:
    """One view in the solution: T_camera_board (4, 4), its error in the fit and held out."""

    id: str
    pose: Array
    rms_px: float
    held_out_px: float
    tilt_deg: float


@dataclass(frozen=True, eq=False)
class IntrinsicResult:
    """`sigma` (9,) are the standard deviations of camera.vector. `rms_px` is that of the used
    views; `held_out_px` counts every view, `held_out_used_px` those that the fit rests on.
    `coverage` is the part of the picture inside the hull of all corners. `warp` (3,) is how far
    the board is bent over its `sheet`, metres: see chain.Sheet; zero if the views do not show that
    it is."""

    camera: CameraModel
    sigma: Array
    rms_px: float
    held_out_px: float
    held_out_used_px: float
    views: tuple[ViewFit, ...]
    rejected: tuple[Rejection, ...]
    coverage: float
    warp: Array
    sheet: Sheet

    @property
    def used(self) -> list[str]:
        return [view.id for view in self.views]

    def to_dict(self) -> dict[str, Any]:
        """JSON form, as `cellctl solve --json` prints it."""
        return {
            "views": {"used": self.used, "rejected": [r.to_dict() for r in self.rejected]},
            "rms_px": self.rms_px,
            "held_out_px": self.held_out_px,
            "held_out_used_px": self.held_out_used_px,
            "camera": self.camera.to_dict(),
            "camera_sigma": dict(zip(INTRINSICS, self.sigma.tolist(), strict=True)),
            "board_warp_m": self.warp.tolist(),
            "per_view_px": {v.id: {"rms": v.rms_px, "held_out": v.held_out_px} for v in self.views},
        }


@dataclass(frozen=True, eq=False)
class IntrinsicLimits:
    """What a camera must reach to pass. `focal_sigma` is relative to the focal length."""

    views: int = 6
    held_out_px: float = 1.0
    focal_sigma: float = 0.01
    coverage: float = 0.25
    rejected: float = 1.0 / 3.0


def judge(
    result: IntrinsicResult, limits: IntrinsicLimits | None = None
) -> tuple[str, tuple[str, ...]]:
    """("pass" or "fail", reasons in words); a pass has no reasons."""
    limits = limits or IntrinsicLimits()
    reasons = shortage(len(result.views), len(result.rejected), limits.views, limits.rejected)
    if not result.held_out_used_px <= limits.held_out_px:
        reasons.append(
            f"held-out error {result.held_out_used_px:.2f} px, over the limit of "
            f"{limits.held_out_px} px: check that the pictures are sharp and the board is flat"
        )
    focal_sigma = float(np.max(result.sigma[:2] / result.camera.vector[:2]))
    if not focal_sigma <= limits.focal_sigma:
        reasons.append(_missing_tilt(result, focal_sigma))
    if result.coverage < limits.coverage:
        reasons.append(
            f"the corners cover {100 * result.coverage:.0f} % of the picture, less than "
            f"{100 * limits.coverage:.0f} %: add views with the board near the picture's corners"
        )
    return ("fail" if reasons else "pass"), tuple(reasons)


def _missing_tilt(result: IntrinsicResult, focal_sigma: float) -> str:
    steepest = max(view.tilt_deg for view in result.views)
    return (
        f"the focal length is uncertain by {100 * focal_sigma:.1f} % and the steepest view is "
        f"tilted by {steepest:.0f} degrees: add views tilted by 20-45 degrees about both axes"
    )


@dataclass(frozen=True, eq=False)
class CameraAttempt:
    """A fit, and how it predicts: held-out errors (k, 2) of every view by its id."""

    fit: CameraFit
    rejected: list[Rejection]
    held_out: dict[str, Array]


def solve_intrinsic(
    views: Iterable[View],
    image_size: tuple[int, int],
    *,
    distortion: bool = True,
    warp: bool | None = None,
    minimum_points: int = MINIMUM_POINTS,
) -> IntrinsicResult:
    """Calibrate a camera of `image_size` (w, h) from views of one flat board.

    `distortion` = False keeps all coefficients at zero. `warp` lets the board be bent; None lets
    the held-out error decide. Bad views are rejected with a reason. SolveError names what is
    missing when fewer than three views are left.
    """
    options = [CameraOption(distortion, bent) for bent in (False, True) if warp in (None, bent)]
    return _result(best_camera(ordered(views), image_size, options, minimum_points), image_size)


def best_camera(
    views: Sequence[View],
    image_size: tuple[int, int],
    options: Sequence[CameraOption] = (CameraOption(warp=False), CameraOption(warp=True)),
    minimum_points: int = MINIMUM_POINTS,
) -> CameraAttempt:
    """The first of `options`, simplest first, that predicts views it has not seen as well as the
    best does. SolveError as `solve_intrinsic`."""
    return _choose([_attempt(views, image_size, option, minimum_points) for option in options])


def _attempt(
    views: Sequence[View], image_size: tuple[int, int], option: CameraOption, minimum_points: int
) -> CameraAttempt:
    fit, rejected = fit_camera(views, image_size, option, minimum_points)
    return CameraAttempt(fit, rejected, {view.id: _held_out(view, fit) for view in views})


def _choose(attempts: Sequence[CameraAttempt]) -> CameraAttempt:
    """The simplest that is as good as the best, see `excess`."""
    errors = [list(attempt.held_out.values()) for attempt in attempts]
    best = min(errors, key=lambda views: rms(np.concatenate(views)))
    return next(a for a, views in zip(attempts, errors, strict=True) if excess(views, best) <= 0)


def _held_out(view: View, fit: CameraFit) -> Array:
    """Errors (n, 2) of a view under a camera that never saw it; see `predicted`."""
    rest = fit.without(fit.names.index(view.id)) if view.id in fit.names else fit
    return predicted(view, rest.camera, rest.state.warp, rest.chain.sheet, rest.sigma_px)


def predicted(
    view: View, camera: CameraModel, warp: Array, sheet: Sheet, sigma_px: float = 1.0
) -> Array:
    """Errors (n, 2) of a view under a camera, only the pose of its board, bent by `warp` over
    `sheet`, being fitted. None, (0, 2), of a view whose points do not fix a pose."""
    try:
        pose = board_pose(view, camera).matrix
    except SolveError:
        return np.zeros((0, 2))
    one = np.eye(4)[None]
    chain = Chain(Batch.of([view]), one, one, sheet, Free(), sigma_px)
    state = ChainState(camera, one[0], one[0], pose[None], warp=warp)
    return chain.errors(minimise(chain, state).state)[0]


def _result(attempt: CameraAttempt, image_size: tuple[int, int]) -> IntrinsicResult:
    fit, held_out = attempt.fit, attempt.held_out
    errors, seen, poses = fit.chain.errors(fit.state), fit.chain.batch.seen, fit.state.corrections
    return IntrinsicResult(
        camera=fit.camera,
        sigma=fit.sigma,
        rms_px=rms(errors[seen]),
        held_out_px=rms(np.concatenate(list(held_out.values()))),
        held_out_used_px=rms(np.concatenate([held_out[name] for name in fit.names])),
        views=tuple(
            ViewFit(name, poses[i], rms(errors[i][seen[i]]), rms(held_out[name]), _tilt(poses[i]))
            for i, name in enumerate(fit.names)
        ),
        rejected=tuple(attempt.rejected),
        coverage=_coverage(fit.chain.batch.pixels[seen], image_size),
        warp=fit.state.warp,
        sheet=fit.chain.sheet,
    )


def _tilt(pose: Array) -> float:
    """Angle between the board's normal and the optical axis, degrees."""
    return float(np.degrees(np.arccos(np.clip(abs(pose[2, 2]), 0.0, 1.0))))


def _coverage(pixels: Array, image_size: tuple[int, int]) -> float:
    hull = cv2.convexHull(pixels.astype(np.float32))
    return float(cv2.contourArea(hull)) / (image_size[0] * image_size[1])
