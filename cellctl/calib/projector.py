"""The projector from what the camera sees of its markers on the table.

Markers are found in several pictures. Their undistorted places and their projector pixels are
related by a homography if they lie on one plane, up to the projector's own radial distortion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cellctl.calib.camera import CameraModel
from cellctl.calib.projector_map import (
    ProjectorMap,
    direct_linear_transform,
    homography_jacobian,
)
from cellctl.calib.schur import Linearised, Priors, minimise
from cellctl.calib.views import Rejection, rms
from cellctl.errors import SolveError
from cellctl.geometry import Array, Mask, invert, transform_points

MINIMUM_MARKERS = 12
PLANE_TOLERANCE = 0.0025
"""Of the projector pixels that the markers span: what a lens bends and a table bows stays below,
what lies on another surface above."""
SECOND_SURFACE, SECOND_SURFACE_MARKERS = 0.15, 8
"""Part, and number, of the markers that on a plane of their own make a second surface."""
SAMPLES = 400
INLIER_SIGMAS, INLIER_FLOOR_PX = 6.0, 1.0
HUBER_PX = 1.0
BLOCKS = 3


@dataclass(frozen=True, eq=False)
class LensPrior:
    """What throw ratio and lens shift of the data sheet say: focal length and principal point
    (2,) in projector pixels, the latter within `sigma_px` per axis."""

    focal_px: float
    centre_px: Array
    sigma_px: float = 15.0


@dataclass(frozen=True, eq=False)
class ProjectorResult:
    """Errors in projector pixels. `held_out_px` counts every marker seen, `held_out_used_px`
    those on the table's plane: each was predicted by a map that had not seen its picture."""

    map: ProjectorMap
    rms_px: float
    held_out_px: float
    held_out_used_px: float
    used: tuple[int, ...]
    rejected: tuple[Rejection, ...]

    def to_dict(self) -> dict[str, Any]:
        return {
            "markers": {
                "used": list(self.used),
                "rejected": [rejection.to_dict() for rejection in self.rejected],
            },
            "rms_px": self.rms_px,
            "held_out_px": self.held_out_px,
            "held_out_used_px": self.held_out_used_px,
            "projector": self.map.to_dict(),
        }


@dataclass(frozen=True)
class ProjectorLimits:
    """What a projector map must reach to pass; `used` is the part of the markers seen."""

    markers: int = 40
    used: float = 0.7
    held_out_px: float = 2.0
    shift_px: float = 0.3


@dataclass(frozen=True, eq=False)
class _Sightings:
    """Markers as arrays: ids (n,), projector pixels `pixels` (n, 2), normalised camera
    coordinates `xy` (n, 2), and the fold (n,) with which each is held out."""

    ids: Array
    pixels: Array
    xy: Array
    fold: Array

    def __getitem__(self, index: Mask) -> _Sightings:
        return _Sightings(self.ids[index], self.pixels[index], self.xy[index], self.fold[index])


def solve_projector(
    pictures: Sequence[Mapping[int, Array]],
    centres: Mapping[int, Array],
    camera: CameraModel,
    *,
    lens: LensPrior | None = None,
) -> ProjectorResult:
    """The projector map from pictures {id: camera pixel (2,)} of markers with the projector
    pixels `centres` {id: (2,)}.

    Without `lens` the map is a homography. Held out is one picture at a time; of a single
    picture, one of 3 x 3 blocks of markers. SolveError when the markers are too few, lie on
    several surfaces or are mirrored.
    """
    seen = _sightings(pictures, centres, camera)
    on_plane = _main_plane(seen)
    fit, used = _fit_inliers(seen, on_plane, lens)
    _refuse_second_surface(seen, used)
    _refuse_mirrored(fit)
    held_out = np.empty_like(seen.pixels)
    for fold in np.unique(seen.fold):
        left_out = seen.fold == fold
        rest = _fit(seen[used & ~left_out], lens, start=fit)
        held_out[left_out] = rest.project(seen.xy[left_out]) - seen.pixels[left_out]
    errors = fit.project(seen.xy) - seen.pixels
    return ProjectorResult(
        map=fit,
        rms_px=rms(errors[used]),
        held_out_px=rms(held_out),
        held_out_used_px=rms(held_out[used]),
        used=tuple(int(i) for i in seen.ids[used]),
        rejected=tuple(
            Rejection(str(i), f"{np.linalg.norm(e):.1f} px off the table's plane")
            for i, e in zip(seen.ids[~used], errors[~used], strict=True)
        ),
    )


def judge(
    result: ProjectorResult,
    limits: ProjectorLimits | None = None,
    *,
    shift: float | None = None,
) -> tuple[str, tuple[str, ...]]:
    """("pass" or "fail", reasons); `shift` is `shift_px` between the first and the last look."""
    limits = limits or ProjectorLimits()
    reasons = []
    seen = len(result.used) + len(result.rejected)
    if len(result.used) < limits.markers:
        reasons.append(
            f"only {len(result.used)} markers on the table, {limits.markers} are needed: clear the "
            "table and the beam, and check focus and exposure"
        )
    if len(result.used) < limits.used * seen:
        reasons.append(
            f"only {len(result.used)} of {seen} markers lie on one plane: clear the table"
        )
    if not result.held_out_used_px <= limits.held_out_px:
        reasons.append(
            f"held-out error {result.held_out_used_px:.2f} projector px, over the limit of "
            f"{limits.held_out_px} px: check the projector's focus, and that the table is flat"
        )
    if shift is not None and not shift <= limits.shift_px:
        reasons.append(
            f"the markers moved by {shift:.2f} camera px while calibrating, more than "
            f"{limits.shift_px} px: camera, projector or table was touched: "
            "fix them and run again"
        )
    return ("fail" if reasons else "pass"), tuple(reasons)


def turned_deg(
    measured: ProjectorMap,
    T_world_camera: Array,
    T_world_projector: Array,
    lens: LensPrior,
    *,
    spot: Array,
) -> float:
    """By how much the picture is turned, at a `spot` (3,) of the table, against a projector of
    that lens at that pose."""
    points = spot + 0.01 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    seen = transform_points(invert(T_world_camera), points)
    lit = transform_points(invert(T_world_projector), points)
    pixels = measured.project(seen[:, :2] / seen[:, 2:])
    expected = lens.focal_px * lit[:, :2] / lit[:, 2:]
    turn = (pixels[1:] - pixels[0]).T @ np.linalg.inv((expected[1:] - expected[0]).T)
    return float(np.degrees(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])))


def judge_turn(degrees: float) -> tuple[str, ...]:
    """Why a picture that is turned so fails."""
    reason = (
        "the projector's picture is upside down against the projector's pose in the config: switch "
        "its ceiling mode, or correct the pose"
    )
    return (reason,) if abs(degrees) > 135.0 else ()


def shift_px(before: Mapping[int, Array], after: Mapping[int, Array]) -> float:
    """Median distance in camera pixels between two detections {id: (2,)} of the same markers.

    SolveError when fewer than half of the markers were seen again.
    """
    common = sorted(before.keys() & after.keys())
    if not common or 2 * len(common) < len(before):
        raise SolveError(f"only {len(common)} of {len(before)} projected markers were seen again")
    return float(np.median([np.linalg.norm(after[i] - before[i]) for i in common]))


def _sightings(
    pictures: Sequence[Mapping[int, Array]], centres: Mapping[int, Array], camera: CameraModel
) -> _Sightings:
    found = [
        (number, fold, pixel)
        for fold, picture in enumerate(pictures)
        for number, pixel in picture.items()
        if number in centres
    ]
    found.sort(key=lambda item: item[:2])
    if len(found) < MINIMUM_MARKERS:
        raise SolveError(
            f"only {len(found)} projected markers were found, {MINIMUM_MARKERS} are needed: is the "
            "projector on, in focus and on the table, and the picture neither dark nor saturated?"
        )
    ids = np.array([number for number, _, _ in found])
    pixels = np.array([centres[number] for number in ids], dtype=float)
    xy = camera.normalise(np.array([pixel for _, _, pixel in found]))
    if not np.isfinite(xy).all():
        raise SolveError("the camera's distortion has no inverse where markers were seen")
    fold = np.array([fold for _, fold, _ in found])
    if len(np.unique(fold)) == 1:
        fold = blocks(pixels)
    return _Sightings(ids, pixels, xy, fold)


def blocks(pixels: Array) -> Array:
    """Number (n,) of the block that each of pixels (n, 2) lies in: BLOCKS x BLOCKS."""
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    cell = np.minimum((pixels - low) / np.maximum(high - low, 1e-9) * BLOCKS, BLOCKS - 1)
    return cell.astype(int) @ [1, BLOCKS]


def _main_plane(seen: _Sightings) -> Mask:
    """Which markers (n,) lie roughly on the plane that most of them share."""
    on_plane = _consensus(seen)
    if on_plane.sum() < MINIMUM_MARKERS:
        raise SolveError(
            f"at most {on_plane.sum()} of {len(seen.ids)} projected markers lie on one plane, "
            f"{MINIMUM_MARKERS} are needed: clear the table and the beam"
        )
    return on_plane


def _refuse_second_surface(seen: _Sightings, used: Mask) -> None:
    """SolveError when many of the markers that do not fit lie on a plane of their own."""
    enough = max(SECOND_SURFACE_MARKERS, SECOND_SURFACE * len(seen.ids))
    if np.count_nonzero(~used) < enough:
        return
    second = int(_consensus(seen[~used]).sum())
    if second >= enough:
        raise SolveError(
            f"the projected markers lie on several surfaces: {used.sum()} on one plane, {second} "
            "on another; clear the table and the beam"
        )


def _consensus(seen: _Sightings) -> Mask:
    """The set (n,) that one homography explains best, within PLANE_TOLERANCE.

    Random samples of four, always the same ones; what does not fit counts like the tolerance:
    Torr and Zisserman, MLESAC, 2000.
    """
    tolerance = PLANE_TOLERANCE * float(np.linalg.norm(np.ptp(seen.pixels, axis=0)))
    rng = np.random.default_rng(0)
    picks = np.array([rng.choice(len(seen.ids), 4, replace=False) for _ in range(SAMPLES)])
    with np.errstate(all="ignore"):
        maps = direct_linear_transform(seen.xy[picks], seen.pixels[picks])
        rows = np.einsum("sij,nj->sni", maps[..., :2], seen.xy) + maps[:, None, :, 2]
        off = np.linalg.norm(rows[..., :2] / rows[..., 2:] - seen.pixels, axis=-1)
    off = np.where(np.isfinite(off), off, np.inf)
    best = np.argmin(np.square(np.minimum(off, tolerance)).sum(axis=1))
    return off[best] < tolerance


def _fit_inliers(seen: _Sightings, used: Mask, lens: LensPrior | None) -> tuple[ProjectorMap, Mask]:
    """The map of the plane's markers, and which of all markers agree with it."""
    for _ in range(3):
        fit = _fit(seen[used], lens)
        off = np.linalg.norm(fit.project(seen.xy) - seen.pixels, axis=1)
        sigma = float(np.median(off[used])) / 1.1774
        used = off < max(INLIER_SIGMAS * sigma, INLIER_FLOOR_PX)
        if used.sum() < MINIMUM_MARKERS:
            raise SolveError("the projected markers contradict each other: no plane explains them")
    return _fit(seen[used], lens), used


def _fit(
    seen: _Sightings, lens: LensPrior | None, start: ProjectorMap | None = None
) -> ProjectorMap:
    """Least squares in projector pixels, Huber's loss."""
    if start is None:
        H = direct_linear_transform(seen.xy, seen.pixels)
        start = _with_lens(H, lens)
    return minimise(MapProblem(seen.xy, seen.pixels, lens), start, huber=HUBER_PX).state


def _with_lens(H: Array, lens: LensPrior | None) -> ProjectorMap:
    if lens is None:
        return ProjectorMap.pinhole(H)
    return ProjectorMap(H, lens.centre_px, lens.focal_px, np.zeros(2))


@dataclass(frozen=True, eq=False)
class MapProblem:
    """A least-squares problem (schur.Problem) without local unknowns: normalised camera
    coordinates `xy` (n, 2), the projector's `pixels` (n, 2), and what each coordinate of them
    counts, `weights` (n, 2), else 1. Globals: H's first eight entries and, with a lens, k1, k2
    and the centre in standard deviations of its prior."""

    xy: Array
    pixels: Array
    lens: LensPrior | None
    weights: Array | None = None

    def _weighted(self, pixels: Array) -> Array:
        off = pixels - self.pixels
        return (off if self.weights is None else off * self.weights)[None]

    def residuals(self, state: ProjectorMap) -> Array:
        return self._weighted(state.project(self.xy))

    def linearise(self, state: ProjectorMap) -> Linearised:
        ideal, by_H = homography_jacobian(state.H, self.xy)
        columns = [by_H]
        pixels = ideal
        if self.lens is not None:
            pixels, by_ideal, by_radial, by_centre = state.lens_jacobians(ideal)
            columns = [by_ideal @ by_H, by_radial, by_centre * self.lens.sigma_px]
        jacobian = np.concatenate(columns, axis=-1)[None]
        if self.weights is not None:
            jacobian = jacobian * self.weights[None, ..., None]
        return Linearised(self._weighted(pixels), jacobian, jacobian[..., :0])

    def priors(self, state: ProjectorMap) -> Priors:
        on_locals, by_locals = np.zeros((1, 0)), np.zeros((1, 0, 0))
        if self.lens is None:
            return Priors(np.zeros(0), np.zeros((0, 8)), on_locals, by_locals)
        off = (state.centre - self.lens.centre_px) / self.lens.sigma_px
        return Priors(off, np.eye(2, 12, k=10), on_locals, by_locals)

    def retract(self, state: ProjectorMap, by_globals: Array, by_locals: Array) -> ProjectorMap:
        del by_locals
        H = state.H + np.append(by_globals[:8], 0.0).reshape(3, 3)
        if self.lens is None:
            return ProjectorMap.pinhole(H)
        centre = state.centre + by_globals[10:] * self.lens.sigma_px
        return ProjectorMap(H, centre, state.focal_px, state.radial + by_globals[8:10])


def _refuse_mirrored(fit: ProjectorMap) -> None:
    if np.linalg.det(fit.H) < 0:
        raise SolveError(
            "the camera sees the projector's picture mirrored: switch off the projector's rear or "
            "ceiling mode, and check that the camera's driver does not flip its pictures"
        )
