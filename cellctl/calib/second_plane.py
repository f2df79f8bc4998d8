"""The projector's full model in the robot's frame, from light on the table and on held boards.

From one plane a projector's focal length and pose cannot be told apart; a second one at another
height tells them. Light on a known plane is a known point in space, where the camera's ray meets
the plane: then the projector is resected from its points as a camera is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from cellctl.calib.camera import CameraModel
from cellctl.calib.pose import derivatives_by_pose, pose_matrices
from cellctl.calib.procam_fit import plausible
from cellctl.calib.procam_problem import Plausible, moved
from cellctl.calib.projector import LensPrior
from cellctl.calib.schur import Linearised, Priors, minimise
from cellctl.calib.views import rms
from cellctl.errors import SolveError
from cellctl.geometry import Array, Transform, invert, pose_matrix, transform_points

FREE = (0, 1, 2, 3, 4, 5)
"""Focal lengths, principal point, k1 and k2: places in camera.INTRINSICS."""
FOCAL_SIGMA = 0.05
"""What a data sheet's throw ratio is worth."""
SIGMA_PX, HUBER, ASPECT = 0.3, 4.0, 0.002
LEAST_POINTS, LEAST_APART_M = 12, 0.03


@dataclass(frozen=True, eq=False)
class LitPlane:
    """Light on a flat thing: projector pixels (n, 2), camera pixels (n, 2), and where the thing
    was, `T_camera_plane` (4, 4); its points have z = 0 there."""

    id: str
    projector_px: Array
    camera_px: Array
    T_camera_plane: Array

    def points(self, camera: CameraModel) -> Array:
        """Where the light lies, (n, 3) in the camera frame."""
        xy = camera.normalise(self.camera_px)
        rays = np.column_stack([xy, np.ones(len(xy))])
        normal = self.T_camera_plane[:3, 2]
        depth = (normal @ self.T_camera_plane[:3, 3]) / (rays @ normal)
        return rays * depth[:, None]


@dataclass(frozen=True, eq=False)
class FullProjector:
    """A projector in the robot's frame; errors in its pixels. `held_out_px`: each held board
    predicted by a fit without it, None when there is but one. `sigma` (6,) of the free lens
    parameters FREE."""

    lens: CameraModel
    T_world_projector: Transform
    sigma: Array
    rms_px: float
    held_out_px: float | None
    planes: tuple[str, ...]

    def project(self, points: Array) -> Array:
        """Projector pixels (n, 2) that light points of the world (n, 3), at any height."""
        return self.lens.project(self.T_world_projector.inverse().apply(points))

    def to_dict(self) -> dict[str, Any]:
        lens = self.lens.to_dict()
        return {
            "K": lens["K"],
            "distortion": lens["distortion"],
            "size": lens["image_size"],
            "T_world_projector": self.T_world_projector.to_list(),
            "sigma": self.sigma.tolist(),
            "rms_px": self.rms_px,
            "held_out_px": self.held_out_px,
            "planes": list(self.planes),
        }


def full_projector(
    planes: Sequence[LitPlane],
    camera: CameraModel,
    T_world_camera: Transform,
    size: tuple[int, int],
    lens: LensPrior,
) -> FullProjector:
    """From two planes or more, of which some point is LEAST_APART_M off the first. SolveError when
    they are too few or all one plane."""
    planes = [plane for plane in planes if len(plane.camera_px) >= LEAST_POINTS]
    points = [plane.points(camera) for plane in planes]
    _require_two_planes(planes, points)
    prior = _prior(size, lens)
    fit, sigma = _fit(planes, points, _start(planes, points, size, lens), prior)
    held_out = []
    for i in range(1, len(planes) if len(planes) > 2 else 1):
        rest, _ = _fit([*planes[:i], *planes[i + 1 :]], [*points[:i], *points[i + 1 :]], fit, prior)
        held_out.append(rest.pixels(points[i]) - planes[i].projector_px)
    return FullProjector(
        lens=fit.lens,
        T_world_projector=Transform(
            T_world_camera.parent, "projector", T_world_camera.matrix @ invert(fit.pose)
        ),
        sigma=sigma,
        rms_px=rms(_off(fit, planes, points)),
        held_out_px=rms(np.concatenate(held_out)) if held_out else None,
        planes=tuple(plane.id for plane in planes),
    )


def _require_two_planes(planes: Sequence[LitPlane], points: Sequence[Array]) -> None:
    if planes:
        first = invert(planes[0].T_camera_plane)
        apart = [np.abs(transform_points(first, p)[:, 2]).max() for p in points]
        if max(apart) >= LEAST_APART_M:
            return
    raise SolveError(
        f"light was read on {len(planes)} planes, none of them {1e3 * LEAST_APART_M:.0f} mm off "
        "the first: hold a board into the light at other heights"
    )


@dataclass(frozen=True, eq=False)
class _State:
    lens: CameraModel
    pose: Array

    def pixels(self, points: Array) -> Array:
        return self.lens.project(transform_points(self.pose, points))


@dataclass(frozen=True, eq=False)
class _Resection:
    """A least-squares problem (schur.Problem) without local unknowns: points (n, 3) in the camera
    frame and the projector's `pixels` (n, 2)."""

    points: Array
    pixels: Array
    prior: Plausible

    def residuals(self, state: _State) -> Array:
        return ((state.pixels(self.points) - self.pixels) / SIGMA_PX)[None]

    def linearise(self, state: _State) -> Linearised:
        moved_points = transform_points(state.pose, self.points)
        pixels, by_point, by_lens = state.lens.jacobians(moved_points)
        by_pose = derivatives_by_pose(by_point @ state.pose[:3, :3], self.points)
        columns = np.concatenate([by_lens[..., list(FREE)], by_pose], axis=-1)[None] / SIGMA_PX
        return Linearised(((pixels - self.pixels) / SIGMA_PX)[None], columns, columns[..., :0])

    def priors(self, state: _State) -> Priors:
        residuals, slopes = self.prior.whitened(state.lens, FREE)
        slopes = np.hstack([slopes, np.zeros((len(slopes), 6))])
        return Priors(residuals, slopes, np.zeros((1, 0)), np.zeros((1, 0, 0)))

    def retract(self, state: _State, by_globals: Array, by_locals: Array) -> _State:
        del by_locals
        split = len(FREE)
        turn = pose_matrices(by_globals[None, split:])[0]
        return _State(moved(state.lens, FREE, by_globals[:split]), state.pose @ turn)


def _prior(size: tuple[int, int], lens: LensPrior) -> Plausible:
    usual = plausible(size, None)
    mean, sigma = usual.mean.copy(), usual.sigma.copy()
    mean[:4], sigma[:2] = (
        [lens.focal_px, lens.focal_px, *lens.centre_px],
        FOCAL_SIGMA * lens.focal_px,
    )
    sigma[2:4] = 4.0 * lens.sigma_px
    return replace(usual, mean=mean, sigma=sigma, aspect=ASPECT)


def _start(
    planes: Sequence[LitPlane], points: Sequence[Array], size: tuple[int, int], lens: LensPrior
) -> _State:
    f, (cx, cy) = lens.focal_px, lens.centre_px
    model = CameraModel(np.array([[f, 0, cx], [0, f, cy], [0, 0, 1.0]]), np.zeros(5), size)
    pixels = np.concatenate([plane.projector_px for plane in planes])
    found, turn, shift = cv2.solvePnP(
        np.concatenate(points), pixels, model.K, None, flags=cv2.SOLVEPNP_SQPNP
    )
    if not found:
        raise SolveError("no place of the projector explains where its light was seen")
    return _State(model, pose_matrix(turn, shift))


def _fit(
    planes: Sequence[LitPlane], points: Sequence[Array], start: _State, prior: Plausible
) -> tuple[_State, Array]:
    pixels = np.concatenate([plane.projector_px for plane in planes])
    problem = _Resection(np.concatenate(points), pixels, prior)
    solution = minimise(problem, start, huber=HUBER)
    scale = max(rms(_off(solution.state, planes, points)) / np.sqrt(2) / SIGMA_PX, 0.1)
    return solution.state, scale * np.sqrt(solution.globals_covariance.diagonal()[: len(FREE)])


def _off(fit: _State, planes: Sequence[LitPlane], points: Sequence[Array]) -> Array:
    return np.concatenate(
        [fit.pixels(p) - plane.projector_px for plane, p in zip(planes, points, strict=True)]
    )
