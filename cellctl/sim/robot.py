"""The arm as its controller and the world know it: moves, strokes, faults, and what it touches."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from cellctl.arms import JOINTS
from cellctl.errors import DeviceFault, MotionRefused
from cellctl.geometry import Array, Mask
from cellctl.sim.contact import Obstacles
from cellctl.sim.motion import RING_S, TICK_S, Limits, Motion
from cellctl.sim.noise import keyed
from cellctl.sim.pen import NONE, Pen, Press
from cellctl.sim.truth import Truth

SERVO_SIGMA_RAD = 1e-5
"""How far from the target the servos come to rest; the encoders see it."""
HISTORY_S = 60.0
STRAIGHT_STEPS = 40
"""In which a way is looked at beforehand."""
GRAZE_M = 1e-3
"""An arm that was stopped by a contact may move on if the overlap does not grow by more."""


WRITING_S = 0.004
"""The pen's way is sampled this finely: 0.2 mm at 50 mm/s, half a micron off a small circle."""
CLOSE_M = 0.02
"""The pen is looked at closely when it is nearer to the table."""
COARSE, NEAR_M, NEAR_STROKE_M = 4, 0.08, 0.01
"""Contacts are looked for every so many ticks first, and at each tick where less than that is left;
nothing moves so far in that time, and in a stroke much less."""


@dataclass(frozen=True)
class Collision:
    """A contact: when, between what, where the flange was (m, world)."""

    t: float
    between: tuple[str, str]
    flange_m: tuple[float, float, float]


@dataclass(frozen=True)
class Event:
    """What will stop a motion at `t`: a contact `between` two, or the one that a touch feels."""

    t: float
    between: tuple[str, str] | None = None
    reason: str = ""


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
        self._feels: float | None = None
        self._felt: float | None = None
        self._stroking, self._stroke = False, (t, t)
        self.pen = Pen(truth)

    def surround(self, now: float, truth: Truth) -> None:
        """From now on, the things around the arm and the pen on it are as `truth` says."""
        self._truth, self._obstacles = truth, Obstacles(truth)
        self.pen.belongs_to(truth)
        self.look_ahead(now)

    def check(self, waypoints: Array) -> None:
        """MotionRefused when a waypoint is outside the controller's joint limits."""
        arm = self._truth.nominal_arm
        for i, inside in enumerate(arm.within_limits(waypoints)):
            if not inside:
                degrees = np.degrees(waypoints[i]).round(1).tolist()
                raise MotionRefused(f"waypoint {i} is outside the joint limits: {degrees} degrees")

    def move(self, now: float, waypoints: Array, limits: Limits, index: str) -> float:
        """Start a move; returns when the commanded motion ends. `index` keys what is random."""
        self._ready(now, waypoints)
        rng = keyed(self._truth.seed, "move", index)
        goal = waypoints[-1] + rng.normal(0.0, SERVO_SIGMA_RAD, JOINTS)
        slip = self._slip(rng, self._truth.preset.arm_errors.repeat_sigma_deg)
        self._lift(now)
        self._stroking = False
        self._motion.follow(now, np.vstack([waypoints[:-1], goal]), limits, slip)
        return self._foresee(now)

    def place(self, now: float, waypoints: Array, limits: Limits, slip: Array) -> float:
        """As `move`, by hand: it ends with the pose error `slip` (6,), which the person saw."""
        self._ready(now, waypoints)
        self._lift(now)
        self._stroking = False
        self._motion.follow(now, waypoints, limits, slip)
        return self._foresee(now)

    def draw(
        self, now: float, waypoints: Array, limits: Limits, index: str, share: float = 1.0
    ) -> float:
        """Start a stroke; returns when it ends. Ink flows for `share` of its way on paper. One
        that begins with the pen on the paper belongs to the stroke before: it lifts the pen."""
        self._ready(now, waypoints)
        seed, preset = self._truth.seed, self._truth.preset
        lifts_only = self.pen_is_down(now)
        self._trace(now, waypoints, limits, index)
        self.pen.way_left = np.inf
        if not lifts_only:
            slipped = keyed(seed, "slip", index).normal(0.0, preset.pen_slip_sigma_m, 2)
            self.pen.slip = np.array([*slipped, 0.0])
            self.pen.stroke, self.pen.strokes = self.pen.strokes, self.pen.strokes + 1
        if share < 1.0:
            self.pen.weaken(self._press(now), share)
        return self._foresee(now)

    def touch(self, now: float, waypoints: Array, limits: Limits, index: str) -> float:
        """Start a stroke that ends where the pen is felt to touch; returns when it ends."""
        self._ready(now, waypoints)
        self._lift(now)
        self._trace(now, waypoints, limits, index)
        pen = self._truth.preset.pen
        self._feels = pen.felt_m + float(
            keyed(self._truth.seed, "touch", index).normal(0.0, pen.felt_sigma_m)
        )
        return self._foresee(now)

    def followed(self, now: float) -> tuple[Array, Array]:
        """What was measured since the last stroke or touch began and until it ended, or `now`:
        times (n,) and joints (n, 6)."""
        began, end = self._stroke
        newest = np.floor(min(now, end) / TICK_S + 1e-6)
        t = np.arange(np.ceil(began / TICK_S), newest + 1) * TICK_S
        return t, self._motion.encoders(t)[0]

    def felt(self, now: float) -> Reading | None:
        """What was measured when the last touch felt its contact; None when it has not."""
        if self._felt is None or self._felt > now:
            return None
        return self.read_at(self._felt, now)

    def stop(self, now: float, *, hard: bool) -> None:
        """Brake. A contact that would have come later does not, unless braking leads to it."""
        self._collisions = [c for c in self._collisions if c.t <= now]
        if self._fault and self._fault[0] > now:
            self._fault = None
        if self._felt is not None and self._felt > now:
            self._felt = None
        self._motion.stop(now, hard=hard)
        self.look_ahead(now)

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

    def settles_at(self, now: float, seconds: float) -> float:
        """When the arm will have stood still for `seconds`, by its own measure."""
        return self._motion.settles_at(now, seconds)

    def read(self, now: float) -> Reading:
        """The newest measurement at `now`. No standstill while a commanded motion is under way,
        even if nothing has been measured of it yet."""
        moving = now < self.moving_until()
        return self._reading(int(np.floor(now / TICK_S + 1e-6)), now, moving=moving)

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

    def _reading(self, tick: int, now: float, *, moving: bool = False) -> Reading:
        t = tick * TICK_S
        joints, speeds = (a[0] for a in self._motion.encoders(np.array([t])))
        flange = self._truth.nominal_arm.forward(joints)
        still = 0.0 if moving else self._motion.standstill_s(tick)
        return Reading(t, joints, speeds, flange, still, self.fault(now))

    def _ready(self, now: float, waypoints: Array) -> None:
        """DeviceFault or MotionRefused when no motion through `waypoints` may start."""
        if fault := self.fault(now):
            raise DeviceFault(f"the arm does not move: {fault}")
        if now < self._motion.standstill_at():
            raise DeviceFault("the arm is moving already; stop it first")
        self.check(waypoints)
        self._feels = None

    def _trace(self, now: float, waypoints: Array, limits: Limits, index: str) -> None:
        rng = keyed(self._truth.seed, "stroke", index)
        off = rng.normal(0.0, SERVO_SIGMA_RAD, JOINTS)
        slip = self._slip(rng, self._truth.preset.arm_errors.drawing_repeat_sigma_deg)
        self._motion.trace(now, waypoints + off, limits, slip)
        self._stroking, self._stroke, self._felt = True, (now, now), None
        self.pen.unwrite(now)

    def _slip(self, rng: np.random.Generator, turn_deg: float) -> Array:
        shift = self._truth.preset.arm_errors.repeat_sigma_m
        return rng.normal(0.0, 1.0, 6) * np.repeat([shift, np.radians(turn_deg)], 3)

    def _lift(self, now: float) -> None:
        """A motion that is no stroke begins: a pen that is in the air sits well again."""
        if not self.pen_is_down(now):
            self.pen.slip, self.pen.stroke = NONE, None

    def pen_is_down(self, now: float) -> bool:
        """Whether it touches the table."""
        t = np.array([now])
        return bool(self.pen.press(t, self._motion.frames(t)).depth[0] >= 0)

    def is_clear(self, waypoints: Array) -> bool:
        """Whether nothing would touch anything on straight joint ways through (n, 6)."""
        shares = np.linspace(0.0, 1.0, STRAIGHT_STEPS)[:, None]
        ways = [a + shares * (b - a) for a, b in itertools.pairwise(waypoints)]
        gaps = self._obstacles.gaps(self._truth.arm.link_frames(np.concatenate(ways)))
        return bool((gaps > 0).all())

    def look_ahead(self, now: float) -> None:
        """Something has changed: see again where the motion leads, and what the pen writes."""
        self.pen.unwrite(now)
        press, since = self._press(now), now
        while event := self._first_event(since, press):
            self._motion.stop(event.t, hard=True)
            self._happen(event)
            press, since = self._press(now), event.t
            if event.between:
                break
        self.pen.write(press)
        if self._stroking:
            self._stroke = self._stroke[0], self._motion.standstill_at()

    def _foresee(self, now: float) -> float:
        self.look_ahead(now)
        return self._motion.standstill_at()

    def _happen(self, event: Event) -> None:
        if not event.between:
            self._felt, self._feels = event.t, None
            return
        flange = self._motion.frames(np.array([event.t]))[0, JOINTS]
        x, y, z = flange[:3, 3].tolist()
        self._collisions.append(Collision(event.t, event.between, (x, y, z)))
        self._fault = (event.t, f"protective stop: {event.reason}")

    def _first_event(self, now: float, press: Press) -> Event | None:
        """What will stop the motion ahead first."""
        if now >= self._motion.standstill_at():
            return None
        events = [self._felt_at(press), self._bottoms_at(press), self._touches_at(now)]
        return min((e for e in events if e and e.t >= now), key=lambda e: e.t, default=None)

    def _felt_at(self, press: Press) -> Event | None:
        t = press.first(self._feels) if self._feels is not None else None
        return None if t is None else Event(t)

    def _bottoms_at(self, press: Press) -> Event | None:
        """The end of the holder's travel; who is beyond it already may not go on."""
        if not len(press.t):
            return None
        travel, now = self._truth.preset.pen.travel_m, float(press.depth[0])
        t = press.first(travel if now <= travel else now + GRAZE_M)
        reason = "pen touched table: the pen holder is at the end of its travel"
        return None if t is None else Event(t, ("pen", "table"), reason)

    def _touches_at(self, now: float) -> Event | None:
        """The first contact of anything else with anything."""
        times = np.arange(now, self._motion.standstill_at() + TICK_S, TICK_S)
        gaps = self._obstacles.gaps(self._motion.frames(times[::COARSE]))
        limit = np.minimum(0.0, gaps[0] - GRAZE_M * (gaps[0] < 0))
        reach = NEAR_STROKE_M if self._stroking else NEAR_M
        near = gaps < limit + reach
        which, times = near.any(axis=0), times[_around(near.any(axis=1), len(times))]
        if not len(times):
            return None
        gaps, limit = self._obstacles.gaps(self._motion.frames(times), which), limit[which]
        touching = gaps < limit
        if not touching.any():
            return None
        first = int(touching.any(axis=1).argmax())
        pairs = [pair for pair, wanted in zip(self._obstacles.pairs, which, strict=True) if wanted]
        pair = pairs[int(np.where(touching[first], gaps[first], np.inf).argmin())]
        return Event(float(times[first]), pair, f"{pair[0]} touched {pair[1]}")

    def _press(self, now: float) -> Press:
        """The pen from `now` to the end of the motion and its ring, as long as it is close."""
        end = self._motion.standstill_at() + RING_S
        coarse = np.arange(now, end + TICK_S, TICK_S) if now < end else np.empty(0)
        close = self.pen.press(coarse, self._motion.frames(coarse)).depth > -CLOSE_M
        if not close.any():
            return Press(np.empty(0), np.empty((0, 2)), np.empty(0))
        near = np.nonzero(close)[0]
        first, last = max(near[0] - 1, 0), min(near[-1] + 1, len(coarse) - 1)
        t = np.arange(coarse[first], coarse[last] + WRITING_S / 2, WRITING_S)
        return self.pen.press(t, self._motion.frames(t))


def _around(coarse: Mask, count: int) -> Mask:
    """Which of `count` ticks are close to those of every COARSE ticks that are marked."""
    every = np.repeat(coarse, COARSE)
    return np.asarray(np.convolve(every, np.ones(2 * COARSE + 1), "same")[:count] > 0)
