"""The arm as its controller and the world know it: moves, faults, and what it bumps into."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cellctl.arms import JOINTS
from cellctl.errors import DeviceFault, MotionRefused
from cellctl.geometry import Array
from cellctl.sim.contact import Obstacles
from cellctl.sim.motion import TICK_S, Limits, Motion
from cellctl.sim.noise import keyed
from cellctl.sim.truth import Truth

SERVO_SIGMA_RAD = 1e-5
"""How far from the target the servos come to rest; the encoders see it."""
HISTORY_S = 60.0
GRAZE_M = 1e-3
"""An arm that was stopped by a contact may move on if the overlap does not grow by more."""


@dataclass(frozen=True)
class Collision:
    """A contact: when, between what, where the flange was (m, world)."""

    t: float
    between: tuple[str, str]
    flange_m: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Reading:
    """What the controller reports at `t`: encoder joints (6,), speeds (6,), nominal
    T_world_flange (4, 4), for how long it has stood still, and its fault."""

    t: float
    joints: Array
    speeds: Array
    flange: Array
    standstill_s: float
    fault: str | None


class Arm:
    """The simulated arm. All times are the world's; nothing happens but what time brings."""

    def __init__(self, truth: Truth, t: float) -> None:
        self._truth, self._began = truth, t
        arms = (truth.nominal_arm, truth.arm)
        home = np.radians(truth.preset.home_deg)
        self._motion = Motion(arms, truth.nominal_pen, home, truth.ring_hz, t)
        self._obstacles = Obstacles(truth)
        self._collisions: list[Collision] = []
        self._fault: tuple[float, str] | None = None

    def surround(self, truth: Truth) -> None:
        """The things around the arm are now where `truth` says."""
        self._obstacles = Obstacles(truth)

    def check(self, waypoints: Array) -> None:
        """MotionRefused when a waypoint is outside the controller's joint limits."""
        arm = self._truth.nominal_arm
        for i, inside in enumerate(arm.within_limits(waypoints)):
            if not inside:
                degrees = np.degrees(waypoints[i]).round(1).tolist()
                raise MotionRefused(f"waypoint {i} is outside the joint limits: {degrees} degrees")

    def move(self, now: float, waypoints: Array, limits: Limits, index: str) -> float:
        """Start a move; returns when the commanded motion ends. `index` keys what is random."""
        if fault := self.fault(now):
            raise DeviceFault(f"the arm does not move: {fault}")
        if now < self._motion.standstill_at():
            raise DeviceFault("the arm is moving already; stop it first")
        self.check(waypoints)
        rng = keyed(self._truth.seed, "move", index)
        goal = waypoints[-1] + rng.normal(0.0, SERVO_SIGMA_RAD, JOINTS)
        self._motion.follow(now, np.vstack([waypoints[:-1], goal]), limits, self._slip(rng))
        self._watch(now)
        return self._motion.standstill_at()

    def stop(self, now: float, *, hard: bool) -> None:
        """Brake. A contact that would have come later does not, unless braking leads to it."""
        self._collisions = [c for c in self._collisions if c.t <= now]
        if self._fault and self._fault[0] > now:
            self._fault = None
        self._motion.stop(now, hard=hard)
        self._watch(now)

    def protective_stop(self, now: float, reason: str) -> None:
        self.stop(now, hard=True)
        self._fault = (now, f"protective stop: {reason}")

    def clear_fault(self, now: float) -> None:
        """What a person does at the pendant."""
        if self.fault(now):
            self._fault = None

    def fault(self, now: float) -> str | None:
        return self._fault[1] if self._fault and self._fault[0] <= now else None

    def collisions(self, now: float) -> list[Collision]:
        return [c for c in self._collisions if c.t <= now]

    def moving_until(self) -> float:
        return self._motion.standstill_at()

    def read(self, now: float) -> Reading:
        """The newest measurement at `now`. No standstill while a commanded motion is under way,
        even if nothing has been measured of it yet."""
        reading = self._reading(int(np.floor(now / TICK_S + 1e-6)), now)
        return replace(reading, standstill_s=0.0) if now < self.moving_until() else reading

    def read_at(self, t: float, now: float) -> Reading:
        """Interpolated between measurements; DeviceFault when `t` is not covered."""
        oldest = max(self._began, now - HISTORY_S)
        if not oldest <= t <= now:
            raise DeviceFault(
                f"no robot state at t = {t:.3f} s: the record covers {oldest:.3f} to {now:.3f} s"
            )
        newest = int(np.floor(now / TICK_S + 1e-6))
        before = min(int(np.floor(t / TICK_S)), newest)
        first, second = self._reading(before, now), self._reading(min(before + 1, newest), now)
        share = float(np.clip((t - first.t) / TICK_S, 0.0, 1.0))
        joints = first.joints + share * (second.joints - first.joints)
        speeds = first.speeds + share * (second.speeds - first.speeds)
        still = first.standstill_s > 0 and second.standstill_s > 0
        flange = self._truth.nominal_arm.forward(joints)
        standstill = first.standstill_s + (t - first.t) if still else 0.0
        return Reading(t, joints, speeds, flange, standstill, first.fault)

    def frames(self, t: Array) -> Array:
        """True link frames (n, 7, 4, 4) at times (n,)."""
        return self._motion.frames(t)

    def forget(self, before: float) -> None:
        self._motion.forget(before)

    def _reading(self, tick: int, now: float) -> Reading:
        t = tick * TICK_S
        joints, speeds = (a[0] for a in self._motion.encoders(np.array([t])))
        flange = self._truth.nominal_arm.forward(joints)
        return Reading(t, joints, speeds, flange, self._motion.standstill_s(tick), self.fault(now))

    def _slip(self, rng: np.random.Generator) -> Array:
        errors = self._truth.preset.arm_errors
        turn = np.radians(errors.repeat_sigma_deg)
        return rng.normal(0.0, 1.0, 6) * np.repeat([errors.repeat_sigma_m, turn], 3)

    def _watch(self, now: float) -> None:
        """Find the first contact of the motion ahead; it will stop the arm, hard."""
        if now >= self._motion.standstill_at():
            return
        times = np.arange(now, self._motion.standstill_at() + TICK_S, TICK_S)
        frames = self._motion.frames(times)
        gaps, pairs = self._obstacles.gaps(frames)
        touching = gaps < np.minimum(0.0, gaps[0] - GRAZE_M * (gaps[0] < 0))
        if not touching.any():
            return
        first = int(touching.any(axis=1).argmax())
        pair = pairs[int(np.where(touching[first], gaps[first], np.inf).argmin())]
        x, y, z = frames[first, JOINTS, :3, 3].tolist()
        t = float(times[first])
        self._collisions.append(Collision(t, pair, (x, y, z)))
        self._fault = (t, f"protective stop: {pair[0]} touched {pair[1]}")
        self._motion.stop(t, hard=True)
