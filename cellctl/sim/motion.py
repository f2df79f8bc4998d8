"""How the arm moves: synchronised trapezoidal joint motion, true deceleration, and a ring after.

All joints start and arrive together. A move goes along straight joint lines and stops at every
waypoint; a stroke goes through its waypoints without stopping, at constant speed of the tip. The
controller reports what its encoders see. The true pose differs: the arm's own
errors are in `Truth.arm`; each move has a repeatability error of its own; and for half a second
after a deceleration the arm rings, of which the encoders see only a part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from cellctl.arms import JOINTS, ArmModel
from cellctl.geometry import Array
from cellctl.sim.track import Curve, Straight, Track, thinned

RING_S = 0.5
RING_DECAY_S = 0.12
RING_GAIN = 2.0
"""The stand gives way like the joints do."""
ENCODER_SHARE = 0.12
"""How much of the ring the encoders see; the rest is in gears and tubes behind them."""
STILL_RAD_S = 1e-3
"""The controller reports a joint speed below this as zero."""
SETTLE_RAD, SETTLE_S = 1e-4, 0.016
"""A move to where the arm already is takes this long: brakes and servo settle anew."""
TICK_S = 0.008
"""The controller measures at 125 Hz."""
STILL_TICKS = 16
"""So many at a time are looked at for the last motion."""


class Course:
    """A way s(t) under piecewise constant acceleration, from 0 at t = 0.

    `phases` are (duration, acceleration); it stands still before and after.
    """

    def __init__(self, speed: float, phases: Sequence[tuple[float, float]]) -> None:
        self._times, self._ways, self._speeds = [0.0], [0.0], [speed]
        self._gains = [gain for _, gain in phases]
        for duration, gain in phases:
            self._times.append(self._times[-1] + duration)
            way = (self._speeds[-1] + gain * duration / 2) * duration
            self._ways.append(self._ways[-1] + way)
            self._speeds.append(self._speeds[-1] + gain * duration)

    @classmethod
    def trapezoid(cls, rate: float, gain: float) -> Course:
        """From 0 to 1, at rest at both ends, under these limits."""
        peak = min(rate, float(np.sqrt(gain)))
        ramp = peak / gain
        return cls(0.0, [(ramp, gain), (1.0 / peak - ramp, 0.0), (ramp, -gain)])

    @property
    def duration(self) -> float:
        return self._times[-1]

    @property
    def last_gain(self) -> float:
        """The acceleration with which it ends; negative when it brakes."""
        return self._gains[-1]

    def at(self, t: Array) -> tuple[Array, Array]:
        """Way and speed (n,) at times (n,)."""
        phase = np.clip(np.searchsorted(self._times, t, "right") - 1, 0, len(self._gains) - 1)
        since = np.clip(t, 0.0, self.duration) - np.take(self._times, phase)
        gain, start = np.take(self._gains, phase), np.take(self._speeds, phase)
        way = np.take(self._ways, phase) + (start + gain * since / 2) * since
        running = (t >= 0) & (t < self.duration)
        return way, np.where(running, start + gain * since, 0.0)


@dataclass(frozen=True, eq=False)
class Leg:
    """Along `track` from the way `begin` on to the joints `goal` (6,), beginning at `t0`. The
    pose error at the flange (translation m, rotation rad, (6,)) goes from `slip` to `next_slip`.
    A leg that is cut short by the next one has `cut` set and does not ring."""

    t0: float
    track: Track
    begin: float
    goal: Array
    course: Course
    slip: Array
    next_slip: Array
    cut: bool = False

    @property
    def end(self) -> float:
        return self.t0 + self.course.duration

    def at(self, t: Array) -> tuple[Array, Array, Array]:
        """Joints, speeds and slip (n, 6) at times (n,)."""
        way, speed = self.course.at(t - self.t0)
        share = np.clip((t - self.t0) / self.course.duration, 0.0, 1.0)[:, None]
        slip = self.slip + share * (self.next_slip - self.slip)
        joints, slope = self.track.at(self.begin + way)
        # Exactly there, whatever way led there: the same pose taken again is the same pose.
        there = (t >= self.end)[:, None]
        joints, slip = np.where(there, self.goal, joints), np.where(there, self.next_slip, slip)
        return joints, speed[:, None] * slope, slip

    def last_slope(self) -> Array:
        """Change of the joints (6,) a unit of way where the leg ends."""
        way = self.course.at(np.array([self.course.duration]))[0]
        return self.track.at(self.begin + way)[1][0]


@dataclass(frozen=True, eq=False)
class Limits:
    """Of one move: joint speeds (6,) rad/s, accelerations (6,) rad/s^2, speed of the tool m/s."""

    speed: Array
    acceleration: Array
    tool_speed: float


class Motion:
    """Where the arm has been, is, and will be if nothing stops it."""

    def __init__(
        self, arms: tuple[ArmModel, ArmModel], tool: Array, home: Array, ring_hz: float, t: float
    ) -> None:
        """`arms` are the nominal and the true one; at rest at `home` since `t`."""
        self._arm, self._true_arm = arms
        self._tool, self._ring = tool, 2 * np.pi * ring_hz
        nothing = np.zeros(JOINTS)
        self._legs = [_settling(t - SETTLE_S, home, nothing, nothing)]

    def follow(self, now: float, waypoints: Array, limits: Limits, slip: Array) -> float:
        """Go through waypoints (n, 6) from where the arm stands; returns when it will stand
        again. `slip` (6,) is the pose error that this move ends with."""
        joints, _, before = (a[0] for a in self._at(np.array([now])))
        t = now
        for i, waypoint in enumerate(waypoints):
            after = slip if i == len(waypoints) - 1 else before
            delta = waypoint - joints
            course = self._course(joints, delta, limits)
            track = Straight(joints, delta)
            self._legs.append(Leg(t, track, 0.0, waypoint, course, before, after))
            t, joints, before = self._legs[-1].end, waypoint, after
        return t

    def trace(self, now: float, waypoints: Array, limits: Limits, slip: Array) -> float:
        """As `follow`, but through the waypoints without stopping, at constant speed of the tip;
        it is `slip` (6,) off from the beginning. MotionRefused when they are too far apart."""
        joints, _, before = (a[0] for a in self._at(np.array([now])))
        way = np.vstack([joints, waypoints])
        tips = self._tips(way)
        kept = thinned(way, tips)
        curve = Curve(way[kept], tips[kept])
        speed, acceleration = self._own(limits)
        rate = curve.rate(speed, acceleration, limits.tool_speed)
        course = Course.trapezoid(rate, curve.hardest(acceleration, rate))
        settled = _settling(now, joints, before, slip)
        self._legs += [settled, Leg(settled.end, curve, 0.0, way[-1], course, slip, slip)]
        return self._legs[-1].end

    def stop(self, now: float, *, hard: bool) -> None:
        """Brake from `now`: as the move would have braked, or as hard as the arm can."""
        self._legs = [leg for leg in self._legs if leg.t0 <= now]
        leg = self._legs[-1]
        if now >= leg.end:
            return
        way, speed = (float(a[0]) for a in leg.course.at(np.array([now - leg.t0])))
        slip = leg.at(np.array([now]))[2][0]
        gain = abs(leg.course.last_gain)
        if hard or gain == 0.0:
            gain = leg.track.hardest(self._arm.max_acceleration, speed)
        course = Course(speed, [(max(speed / gain, 1e-6), -gain)])
        self._legs[-1] = replace(leg, cut=True)
        begin = leg.begin + way
        end = begin + course.at(np.array([course.duration]))[0]
        goal = leg.track.at(end)[0][0]
        self._legs.append(Leg(now, leg.track, begin, goal, course, slip, slip))

    def standstill_at(self) -> float:
        """When the commanded motion ends, or ended."""
        return self._legs[-1].end

    def encoders(self, t: Array) -> tuple[Array, Array]:
        """Joints and joint speeds (n, 6) as the controller measures them at times (n,)."""
        joints, speeds, _ = self._at(t)
        ring, ring_speeds = self._ringing(t)
        speeds = speeds + ENCODER_SHARE * ring_speeds
        still = np.abs(speeds) < STILL_RAD_S
        return joints + ENCODER_SHARE * ring, np.where(still, 0.0, speeds)

    def standstill_s(self, tick: int) -> float:
        """For how long, at this tick, all reported joint speeds have been zero."""
        for leg in reversed([leg for leg in self._legs if leg.t0 <= tick * TICK_S]):
            newest = min(tick, int(np.ceil((leg.end + RING_S) / TICK_S)))
            oldest = int(np.floor(leg.t0 / TICK_S))
            for last in range(newest, oldest - 1, -STILL_TICKS):  # the newest ones mostly tell
                ticks = np.arange(max(oldest, last + 1 - STILL_TICKS), last + 1)
                moving = ticks[self.encoders(ticks * TICK_S)[1].any(axis=1)]
                if len(moving):
                    return float((tick - moving[-1]) * TICK_S)
        return tick * TICK_S - self._legs[0].t0

    def settles_at(self, now: float, seconds: float) -> float:
        """When, from `now` on in ticks, the motion will be over and all reported joint speeds have
        been zero for `seconds`, if nothing comes in between."""
        begin = max(now, self.standstill_at())
        before, after = (int(np.ceil(s / TICK_S)) + 1 for s in (seconds, RING_S + seconds))
        places = begin + TICK_S * np.arange(after + 1)
        asked = np.floor(places / TICK_S + 1e-6).astype(int)
        ticks = np.arange(asked[0] - before, asked[-1] + 1)
        moving = self.encoders(ticks * TICK_S)[1].any(axis=1)
        unmoved = max((ticks[0] - 1) * TICK_S, self._legs[0].t0)
        newest = np.maximum.accumulate(np.where(moving, ticks * TICK_S, unmoved))
        still = asked * TICK_S - newest[asked - ticks[0]] >= seconds - 1e-9
        return float(places[int(np.argmax(still))]) if still.any() else float(places[-1])

    def frames(self, t: Array) -> Array:
        """True link frames (n, 7, 4, 4) in the world at times (n,); the last is the flange."""
        joints, _, slips = self._at(t)
        frames = self._true_arm.link_frames(joints + self._ringing(t)[0])
        errors = np.tile(np.eye(4), (len(t), 1, 1))
        errors[:, :3, :3] = Rotation.from_rotvec(slips[:, 3:]).as_matrix()
        errors[:, :3, 3] = slips[:, :3]
        frames[:, JOINTS] = frames[:, JOINTS] @ errors
        return frames

    def forget(self, before: float) -> None:
        """Drop what only matters for times before `before`."""
        while len(self._legs) > 1 and self._legs[0].end + RING_S < before > self._legs[1].t0:
            del self._legs[0]

    def _at(self, t: Array) -> tuple[Array, Array, Array]:
        """Commanded joints, speeds and slips (n, 6), without the ring."""
        starts = [leg.t0 for leg in self._legs]
        which = np.maximum(np.searchsorted(starts, t, "right") - 1, 0)
        result = np.empty((3, len(t), JOINTS))
        for i in np.unique(which):
            mine = which == i
            result[:, mine] = self._legs[i].at(t[mine])
        return result[0], result[1], result[2]

    def _ringing(self, t: Array) -> tuple[Array, Array]:
        """Deflection of the joints and its speed (n, 6): that of springs that the braking has
        loaded (deceleration / omega^2 each), damped, and exactly zero after RING_S."""
        joints, speeds = np.zeros((len(t), JOINTS)), np.zeros((len(t), JOINTS))
        for leg in self._legs:
            since = t - leg.end
            on = (since >= 0) & (since < RING_S)
            if leg.cut or leg.course.last_gain >= 0 or not on.any():
                continue
            push = leg.last_slope() * (-RING_GAIN * leg.course.last_gain / self._ring**2)
            x = since[on, None]
            fade, left = np.exp(-x / RING_DECAY_S), 1 - x / RING_S
            sine, cosine = np.sin(self._ring * x), np.cos(self._ring * x)
            joints[on] += push * fade * left**2 * sine
            change = self._ring * cosine * left - sine * (left / RING_DECAY_S + 2 / RING_S)
            speeds[on] += push * fade * left * change
        return joints, speeds

    def _course(self, start: Array, delta: Array, limits: Limits) -> Course:
        reach = np.maximum(np.abs(delta), 1e-12)
        if reach.max() < SETTLE_RAD:
            return Course(1.0 / SETTLE_S, [(SETTLE_S, 0.0)])
        speed, acceleration = self._own(limits)
        steps = np.linspace(0.0, 1.0, 33)
        tips = self._tips(start + steps[:, None] * delta)
        fastest = np.linalg.norm(np.diff(tips, axis=0), axis=1).max() / steps[1]
        rate = min(float((speed / reach).min()), limits.tool_speed / max(float(fastest), 1e-9))
        return Course.trapezoid(rate, float((acceleration / reach).min()))

    def _own(self, limits: Limits) -> tuple[Array, Array]:
        """Joint speeds and accelerations (6,) under these limits and the arm's own."""
        return (
            np.minimum(limits.speed, self._arm.max_speed),
            np.minimum(limits.acceleration, self._arm.max_acceleration),
        )

    def _tips(self, joints: Array) -> Array:
        """Where the controller believes the tool's tip (n, 3) at joints (n, 6)."""
        flanges = self._arm.forward(joints)
        return flanges[:, :3, :3] @ self._tool + flanges[:, :3, 3]


def _settling(t: float, joints: Array, slip: Array, next_slip: Array) -> Leg:
    """Brakes and servos settle anew at `joints` (6,)."""
    rest = Course(0.0, [(SETTLE_S, 0.0)])
    return Leg(t, Straight(joints, np.zeros(JOINTS)), 0.0, joints, rest, slip, next_slip)
