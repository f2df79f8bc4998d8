"""Six-axis arms: Denavit-Hartenberg kinematics, limits and hulls, as the data sheets state them.

Standard DH: `T_i-1_i = Rz(q + theta0) Tz(d) Tx(a) Rx(alpha)`. The base frame is the one in which
the controller reports poses (`world`); the last frame is the flange.

Sources: UR5, CB3 user manual table C.3 and UR's article on DH parameters; IRB 4600, ABB
3HAC032885. A calibrated arm differs from these tables by 1-2 mm: they serve planning and the
guard, never a measurement.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cellctl.errors import BadInput
from cellctl.geometry import Array, Mask

JOINTS = 6


@dataclass(frozen=True)
class Capsule:
    """A link's hull: all points within `radius` of the segment `start`-`end`, metres.

    `frame` is the DH frame that carries it: 0 the base, 6 the flange.
    """

    frame: int
    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float


@dataclass(frozen=True, eq=False)
class ArmModel:
    """DH parameters in radians and metres, all (6,); limits (6, 2) rad; speed and acceleration
    limits (6,) rad/s and rad/s^2; `links` the hull, base first."""

    name: str
    theta0: Array
    d: Array
    a: Array
    alpha: Array
    limits: Array
    max_speed: Array
    max_acceleration: Array
    links: tuple[Capsule, ...]

    def link_frames(self, joints: Array) -> Array:
        """Poses (..., 7, 4, 4) of the DH frames in the base, for joints (..., 6) in radians."""
        steps = self._steps(np.asarray(joints, dtype=float))
        frames = np.empty((*steps.shape[:-3], JOINTS + 1, 4, 4))
        frames[..., 0, :, :] = np.eye(4)
        for i in range(JOINTS):
            frames[..., i + 1, :, :] = frames[..., i, :, :] @ steps[..., i, :, :]
        return frames

    def forward(self, joints: Array) -> Array:
        """T_base_flange (..., 4, 4) for joints (..., 6) in radians."""
        return self.link_frames(joints)[..., JOINTS, :, :]

    def jacobian(self, frames: Array) -> Array:
        """Geometric Jacobian (..., 6, 6) at the flange: metres and radians per radian, base axes.

        `frames` is what `link_frames` returned.
        """
        axes = frames[..., :JOINTS, :3, 2]
        arms = frames[..., JOINTS, None, :3, 3] - frames[..., :JOINTS, :3, 3]
        return np.concatenate(
            [np.swapaxes(np.cross(axes, arms), -1, -2), np.swapaxes(axes, -1, -2)], axis=-2
        )

    def may_reach(self, places: Array) -> Mask:
        """Whether the flange may come to `places` (..., 3) in the base: necessary, not sufficient.

        The second joint's axis goes through a circle around the first one; from there the flange
        is away by the length of all other links at most.
        """
        out = np.linalg.norm(places[..., :2], axis=-1) - abs(self.a[0])
        up = places[..., 2] - self.d[0]
        return np.hypot(out, up) <= np.hypot(self.a[1:], self.d[1:]).sum()

    def perturbed(self, theta: Array, d: Array, a: Array, alpha: Array) -> ArmModel:
        """The same arm with these errors, (6,) each, added to its DH parameters."""
        return replace(
            self,
            theta0=self.theta0 + theta,
            d=self.d + d,
            a=self.a + a,
            alpha=self.alpha + alpha,
        )

    def within_limits(self, joints: Array, margin: float = 0.0) -> Mask:
        """Whether each of joints (..., 6) keeps `margin` radians from every limit."""
        inside = (joints >= self.limits[:, 0] + margin) & (joints <= self.limits[:, 1] - margin)
        return np.logical_and.reduce(inside, axis=-1)

    def _steps(self, joints: Array) -> Array:
        theta = joints + self.theta0
        ct, st = np.cos(theta), np.sin(theta)
        ca, sa = np.cos(self.alpha), np.sin(self.alpha)
        zero, one = np.zeros_like(ct), np.ones_like(ct)
        rows = [
            [ct, -st * ca, st * sa, self.a * ct],
            [st, ct * ca, -ct * sa, self.a * st],
            [zero, sa * one, ca * one, self.d * one],
            [zero, zero, zero, one],
        ]
        return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _radians(*degrees: float) -> Array:
    return np.radians(np.array(degrees, dtype=float))


def _ur5() -> ArmModel:
    return ArmModel(
        name="ur5",
        theta0=np.zeros(JOINTS),
        d=np.array([0.089159, 0.0, 0.0, 0.10915, 0.09465, 0.0823]),
        a=np.array([0.0, -0.425, -0.39225, 0.0, 0.0, 0.0]),
        alpha=_radians(90, 0, 0, 90, -90, 0),
        limits=_radians(-360, 360)[None].repeat(JOINTS, axis=0),
        max_speed=_radians(180, 180, 180, 180, 180, 180),
        max_acceleration=np.full(JOINTS, 8.0),
        links=(
            Capsule(0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.09), 0.075),
            Capsule(1, (0.0, 0.0, -0.02), (0.0, 0.0, 0.136), 0.065),
            Capsule(2, (0.425, 0.0, 0.136), (0.0, 0.0, 0.136), 0.06),
            Capsule(2, (0.0, 0.0, 0.136), (0.0, 0.0, 0.016), 0.055),
            Capsule(3, (0.39225, 0.0, 0.016), (0.0, 0.0, 0.016), 0.05),
            Capsule(3, (0.0, 0.0, 0.016), (0.0, 0.0, 0.10915), 0.045),
            Capsule(4, (0.0, 0.0, 0.0), (0.0, 0.0, 0.09465), 0.045),
            Capsule(5, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0823), 0.04),
        ),
    )


def _irb4600_60() -> ArmModel:
    limits = [(-180, 180), (-90, 150), (-180, 75), (-400, 400), (-125, 120), (-400, 400)]
    return ArmModel(
        name="irb4600-60/2.05",
        theta0=_radians(0, -90, 0, 0, 0, 180),
        d=np.array([0.495, 0.0, 0.0, 0.960, 0.0, 0.135]),
        a=np.array([0.175, 0.900, 0.175, 0.0, 0.0, 0.0]),
        alpha=_radians(-90, 0, -90, 90, -90, 0),
        limits=np.radians(np.array(limits, dtype=float)),
        max_speed=_radians(175, 175, 175, 250, 250, 360),
        max_acceleration=np.full(JOINTS, 5.0),
        links=(
            Capsule(0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.35), 0.25),
            Capsule(1, (-0.175, 0.0, 0.0), (0.0, 0.0, 0.0), 0.22),
            Capsule(2, (-0.900, 0.0, 0.0), (0.0, 0.0, 0.0), 0.18),
            Capsule(3, (-0.175, 0.0, 0.0), (0.0, 0.0, 0.0), 0.18),
            Capsule(3, (0.0, 0.0, 0.0), (0.0, 0.0, 0.80), 0.13),
            Capsule(3, (0.0, 0.0, 0.80), (0.0, 0.0, 0.960), 0.10),
            Capsule(5, (0.0, 0.0, 0.0), (0.0, 0.0, 0.135), 0.09),
        ),
    )


ARMS = {model.name: model for model in (_ur5(), _irb4600_60())}


def arm(name: str) -> ArmModel:
    """The model called `name`; BadInput lists the known ones."""
    if name not in ARMS:
        raise BadInput(f"unknown arm {name!r}; known: {', '.join(sorted(ARMS))}")
    return ARMS[name]
