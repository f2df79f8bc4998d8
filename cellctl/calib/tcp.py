"""The tool's tip from poses in which it stood on one point: pivot calibration.

For every pose, R_i t + p_i = c, with the tip t in the flange's frame and the point c in the
base's: linear least squares. Z. Yaniv, Which pivot calibration?, SPIE Medical Imaging 2015 (there
the algebraic one-step method).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cellctl.calib.linear_fit import LinearFit, Noise, without_gross_errors
from cellctl.calib.views import Rejection
from cellctl.errors import BadInput, SolveError
from cellctl.geometry import Array, rigid

FEWEST = 4
LEAST_TILT_DEG = 1.0
"""With less, the tip's component along the axis is nothing but noise."""
USUAL = Noise(0.3e-3, 6.0)
"""How well a tip is put on a point, metres per axis: what is within that is no gross error."""
OVERTURN = 1.0 / 3.0
"""Share of the poses that may be gross errors."""


@dataclass(frozen=True)
class PivotPose:
    """One used pose: how far its tip is from the common point, and from the point and tip that
    the other poses have, mm."""

    id: str
    residual_mm: float
    held_out_mm: float


@dataclass(frozen=True, eq=False)
class PivotResult:
    """`tip` (3,) in the flange's frame and `point` (3,) in the base's, metres; `covariance` (3, 3)
    of the tip, m^2. `weak_axis` (3,) is the direction in the flange's frame that the poses tilted
    least, `tilt_deg`, by how much: along it the tip is known worst. `condition`: that of the
    equations, columns scaled."""

    tip: Array
    covariance: Array
    point: Array
    poses: tuple[PivotPose, ...]
    rejected: tuple[Rejection, ...]
    weak_axis: Array
    tilt_deg: float
    condition: float
    rms_mm: float
    held_out_mm: float

    @property
    def sigma_mm(self) -> Array:
        """(3,): one standard deviation of the tip along the flange's axes."""
        return 1e3 * np.sqrt(self.covariance.diagonal())

    def to_dict(self) -> dict[str, Any]:
        """JSON form: metres but for what is named _mm, floats survive exactly."""
        return {
            "tip": self.tip.tolist(),
            "covariance": self.covariance.tolist(),
            "point": self.point.tolist(),
            "poses": {
                "used": [pose.id for pose in self.poses],
                "rejected": [r.to_dict() for r in self.rejected],
            },
            "rms_mm": self.rms_mm,
            "held_out_mm": _finite(self.held_out_mm),
            "summary": {
                "sigma_mm": self.sigma_mm.tolist(),
                "weak_axis": self.weak_axis.tolist(),
                "tilt_deg": self.tilt_deg,
                "condition": self.condition,
            },
            "per_pose": {
                pose.id: {
                    "residual_mm": pose.residual_mm,
                    "held_out_mm": _finite(pose.held_out_mm),
                }
                for pose in self.poses
            },
        }


@dataclass(frozen=True)
class PivotLimits:
    """What a pivot must reach to pass. `sigma_mm`: of the tip along its worst known axis."""

    poses: int = 4
    tilt_deg: float = 20.0
    held_out_mm: float = 1.0
    sigma_mm: float = 0.5
    rejected: float = 1.0 / 3.0


def solve_tip(T_base_flange: ArrayLike, ids: Sequence[str] | None = None) -> PivotResult:
    """The tip from poses (n, 4, 4), n >= 4, in which it stands on one fixed point; metres.

    A pose that contradicts the others is left out and named, as long as four remain. `ids` name
    the poses, by default "1" to "n". BadInput when a pose is not rigid or ids do not match;
    SolveError when there are too few poses, or all turn about one axis, which is named.
    """
    poses, names = _checked(T_base_flange, ids)
    rotations = poses[:, :3, :3]
    _refuse_alike(rotations)
    design = np.concatenate([rotations, np.broadcast_to(-np.eye(3), rotations.shape)], axis=2)
    most = int(OVERTURN * len(poses))
    fit, used = without_gross_errors(design, -poses[:, :3, 3], USUAL, least=FEWEST, most=most)
    axis, tilt = weakest_tilt(rotations[used])
    residual, held_out = (1e3 * np.linalg.norm(e, axis=1) for e in (fit.residuals, fit.held_out))
    return PivotResult(
        tip=fit.x[:3],
        covariance=fit.variance() * fit.inverse[:3, :3],
        point=fit.x[3:],
        poses=tuple(
            PivotPose(names[i], float(r), float(h))
            for i, r, h in zip(used, residual, held_out, strict=True)
        ),
        rejected=_rejections(design, poses, fit, names, used),
        weak_axis=axis,
        tilt_deg=float(np.degrees(tilt)),
        condition=fit.condition,
        rms_mm=float(np.sqrt(np.mean(residual**2))),
        held_out_mm=float(np.sqrt(np.mean(held_out**2))),
    )


def judge(result: PivotResult, limits: PivotLimits | None = None) -> tuple[str, tuple[str, ...]]:
    """("pass" or "fail", reasons in words); a pass has no reasons."""
    limits = limits or PivotLimits()
    reasons = []
    used, rejected = len(result.poses), len(result.rejected)
    if used < limits.poses:
        reasons.append(f"only {used} poses could be used; at least {limits.poses} are needed")
    if rejected > limits.rejected * (used + rejected):
        reasons.append(f"{rejected} of {used + rejected} poses were rejected")
    if not result.tilt_deg >= limits.tilt_deg:
        reasons.append(
            f"the poses tilt the flange's {axis_name(result.weak_axis)} by only "
            f"{result.tilt_deg:.0f} degrees, and {limits.tilt_deg:.0f} are needed to know the tip "
            "along it: add poses tilted about other axes"
        )
    if not result.held_out_mm <= limits.held_out_mm:
        worst = max(result.poses, key=lambda pose: pose.held_out_mm)
        reasons.append(
            f"held-out error {result.held_out_mm:.2f} mm, over the limit of "
            f"{limits.held_out_mm:g} mm; worst is pose {worst.id!r} with {worst.held_out_mm:.2f} "
            "mm: was the tip on the point, and the point fixed?"
        )
    sigma = 1e3 * float(np.sqrt(np.linalg.eigvalsh(result.covariance)[-1]))
    if not sigma <= limits.sigma_mm:
        reasons.append(
            f"the tip is known to {sigma:.2f} mm (one sigma) along its worst axis, over the limit "
            f"of {limits.sigma_mm:g} mm: add poses"
        )
    return ("fail" if reasons else "pass"), tuple(reasons)


def weakest_tilt(rotations: Array) -> tuple[Array, float]:
    """The direction (3,) in the flange's frame that rotations (n, 3, 3) tilt least, and the
    largest angle (rad) between any two of its pictures in the base's frame.

    The tip is found from R_i t alone, so its component along a direction that all poses leave
    where it is cannot be told from the point.
    """
    mean = rotations.mean(axis=0)
    _, _, vt = np.linalg.svd(mean)  # |mean v| is 1 where no pose moves v
    axis = vt[0] if vt[0][np.argmax(np.abs(vt[0]))] > 0 else -vt[0]
    pictures = rotations @ axis
    chords = np.linalg.norm(pictures[:, None] - pictures[None], axis=-1)
    return axis, float(2.0 * np.arcsin(min(1.0, chords.max() / 2.0)))


def axis_name(axis: Array) -> str:
    """In words: an axis of the flange, or between which it lies."""
    largest = int(np.argmax(np.abs(axis)))
    if abs(axis[largest]) > np.cos(np.radians(15.0)):
        return f"{'xyz'[largest]} axis"
    return f"axis ({', '.join(f'{v:.2f}' for v in axis)})"


def _checked(poses: ArrayLike, ids: Sequence[str] | None) -> tuple[Array, list[str]]:
    try:
        count = len(poses)  # type: ignore[arg-type] # what has no length is refused below
        checked = [rigid(pose, f"pose {i + 1}") for i, pose in enumerate(poses)]  # type: ignore[arg-type]
    except TypeError:
        raise BadInput("poses must be a list of 4x4 matrices T_base_flange") from None
    names = [str(i + 1) for i in range(count)] if ids is None else list(ids)
    if len(names) != count or len(set(names)) < count:
        raise BadInput(f"{count} poses need {count} different ids, not {names}")
    if count < FEWEST:
        raise SolveError(f"{count} poses do not give a tip; at least {FEWEST} are needed")
    return np.stack(checked), names


def _refuse_alike(rotations: Array) -> None:
    axis, tilt = weakest_tilt(rotations)
    if tilt >= np.radians(LEAST_TILT_DEG):
        return
    pairs = np.einsum("iab,jab->ij", rotations, rotations)
    if np.degrees(np.arccos(np.clip((pairs.min() - 1.0) / 2.0, -1.0, 1.0))) < LEAST_TILT_DEG:
        raise SolveError("all poses have the same rotation: turn and tilt the tool about the point")
    raise SolveError(
        f"all poses turn about the flange's {axis_name(axis)} (it was tilted by "
        f"{np.degrees(tilt):.1f} degrees): the tip along it remains unknown; tilt the tool"
    )


def _rejections(
    design: Array, poses: Array, fit: LinearFit, names: list[str], used: Array
) -> tuple[Rejection, ...]:
    """Those not used, with how far their tips are from the point."""
    left_out = np.setdiff1d(np.arange(len(poses)), used)
    off = np.linalg.norm(-poses[left_out, :3, 3] - design[left_out] @ fit.x, axis=1)
    reason = "its tip is {:.1f} mm from the point on which the others agree"
    return tuple(
        Rejection(names[i], reason.format(1e3 * gap)) for i, gap in zip(left_out, off, strict=True)
    )


def _finite(value: float) -> float | None:
    """None for what JSON has no number for."""
    return value if np.isfinite(value) else None
