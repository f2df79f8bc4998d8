"""Fitting a camera to views of a flat board: starts, adjustment, and views that do not belong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from cellctl.calib.camera import CameraModel
from cellctl.calib.chain import FULL, PINHOLE, Chain, ChainState, Free, Sheet
from cellctl.calib.pose import board_pose, on_a_line
from cellctl.calib.schur import Solution, minimise
from cellctl.calib.views import AnyView, Batch, Rejection, View, noise_px, rms
from cellctl.errors import SolveError
from cellctl.geometry import Array, Mask

MINIMUM_VIEWS = 3
MINIMUM_POINTS = 6
HUBER = 4.0
"""Residuals lose weight beyond so many standard deviations: 3e-4 of honest noise does."""
FAR_BEYOND, FAR_SIGMAS = 3.0, 5.0
"""A view is rejected when its error is that many times the median view's, and that many robust
standard deviations above it."""
FOCAL_GUESSES = (0.6, 1.0, 1.7, 3.0)
"""In longer sides of the picture, tried beside the closed form."""


@dataclass(frozen=True)
class CameraOption:
    """What is fitted beside focal lengths, principal point and the boards' poses: five
    coefficients of `distortion`, and the `warp` of the board."""

    distortion: bool = True
    warp: bool = True

    @property
    def free(self) -> Free:
        return Free(intrinsics=FULL if self.distortion else PINHOLE, warp=self.warp)


@dataclass(frozen=True, eq=False)
class CameraFit:
    """A camera fitted to `chain`'s views, which are `names`."""

    names: tuple[str, ...]
    chain: Chain
    solution: Solution[ChainState]

    @property
    def state(self) -> ChainState:
        return self.solution.state

    @property
    def camera(self) -> CameraModel:
        return self.solution.state.camera

    @property
    def sigma_px(self) -> float:
        """Robust noise of a coordinate of a corner."""
        return self.chain.sigma_px

    def without(self, view: int) -> CameraFit:
        """Fitted again without one view, from here."""
        return self.over(np.arange(len(self.names)) != view)

    def over(self, keep: Mask) -> CameraFit:
        """Fitted again over some of the views, from here and with the same noise."""
        names = tuple(name for name, kept in zip(self.names, keep, strict=True) if kept)
        chain = self.chain.subset(keep)
        start = replace(self.state, corrections=self.state.corrections[keep])
        return CameraFit(names, chain, minimise(chain, start, huber=HUBER, tolerance=1e-8))


def fit_camera(
    views: Sequence[View],
    image_size: tuple[int, int],
    option: CameraOption,
    minimum_points: int = MINIMUM_POINTS,
) -> tuple[CameraFit, list[Rejection]]:
    """The camera fitted to all views that agree, and the others with the reason.

    SolveError when fewer than three views are left, or when no camera explains them.
    """
    usable, rejected = usable_views(views, minimum_points)
    _require(usable, rejected)
    fit = _fit(usable, image_size, option)
    while (worst := _far_beyond(fit)) is not None:
        place, reason = worst
        rejected.append(Rejection(usable.pop(place).id, reason))
        _require(usable, rejected)
        fit = _fit(usable, image_size, option)
    return fit, sorted(rejected, key=lambda r: r.id)


def usable_views(views: Sequence[AnyView], minimum: int) -> tuple[list[AnyView], list[Rejection]]:
    """Views from which a pose of the board can be told, and the others."""
    usable: list[AnyView] = []
    rejected: list[Rejection] = []
    for view in views:
        if len(view.points) < minimum:
            reason = f"only {len(view.points)} points of the board seen, {minimum} needed"
            rejected.append(Rejection(view.id, reason))
        elif on_a_line(view.points):
            rejected.append(Rejection(view.id, "all points seen lie on one line of the board"))
        else:
            usable.append(view)
    return usable, rejected


def _require(views: Sequence[View], rejected: Sequence[Rejection]) -> None:
    if len(views) < MINIMUM_VIEWS:
        why = "".join(f"; {r.id}: {r.reason}" for r in rejected[:5])
        raise SolveError(
            f"{len(views)} usable views of the board; a camera needs at least {MINIMUM_VIEWS}, "
            f"tilted in different ways{why}"
        )


def _fit(views: Sequence[View], image_size: tuple[int, int], option: CameraOption) -> CameraFit:
    camera, poses = _start(views, image_size)
    ones = np.broadcast_to(np.eye(4), poses.shape)
    sheet = Sheet.of(np.concatenate([view.points for view in views]))
    chain = Chain(Batch.of(views), ones, ones, sheet, option.free)
    state = ChainState(camera, np.eye(4), np.eye(4), poses)
    for _ in range(3):
        chain = replace(chain, sigma_px=noise_px(chain.errors(state)[chain.batch.seen]))
        solution = minimise(chain, state, huber=HUBER)
        state = solution.state
    return CameraFit(tuple(view.id for view in views), chain, solution)


def _start(views: Sequence[View], image_size: tuple[int, int]) -> tuple[CameraModel, Array]:
    """A pinhole and a pose for each view: Zhang's closed form, or a common focal length if noise
    or one bad view spoils that; whichever explains the median view best."""
    guesses = _zhang(views, image_size) + [factor * max(image_size) for factor in FOCAL_GUESSES]
    best, best_error = None, np.inf
    for focal in guesses:
        camera = _pinhole(focal, image_size)
        try:
            poses = [board_pose(view, camera) for view in views]
        except SolveError:
            continue
        error = float(np.median([pose.rms_px for pose in poses]))
        if error < best_error:
            best, best_error = (camera, np.stack([pose.matrix for pose in poses])), error
    if best is None:
        raise SolveError("no pinhole camera explains the views of the board, not even roughly")
    return best


def _zhang(views: Sequence[View], image_size: tuple[int, int]) -> list[float]:
    """Focal length from the homographies (Z. Zhang, 2000), if they yield a sensible one."""
    points = [view.points.astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32) for view in views]
    focal = float(cv2.initCameraMatrix2D(points, pixels, image_size, 1.0)[0, 0])
    return [focal] if 0.1 < focal / max(image_size) < 100.0 else []


def _pinhole(focal: float, image_size: tuple[int, int]) -> CameraModel:
    w, h = image_size
    K = np.array([[focal, 0.0, (w - 1) / 2], [0.0, focal, (h - 1) / 2], [0.0, 0.0, 1.0]])
    return CameraModel(K, np.zeros(5), image_size)


def _far_beyond(fit: CameraFit) -> tuple[int, str] | None:
    """The worst view and what is wrong with it, or None when all belong together."""
    errors, seen = fit.chain.errors(fit.state), fit.chain.batch.seen
    per_view = np.array([rms(e[s]) for e, s in zip(errors, seen, strict=True)])
    median = float(np.median(per_view))
    spread = 1.4826 * float(np.median(np.abs(per_view - median)))
    worst = int(np.argmax(per_view))
    if per_view[worst] <= max(FAR_BEYOND * median, median + FAR_SIGMAS * spread):
        return None
    reason = f"reprojection error {per_view[worst]:.2f} px; the median view has {median:.2f} px"
    return worst, reason
