"""The simulated cell: truth, time and devices. Pure: no clock, no sockets, no threads.

Time is whatever `advance` says. Stepped, it passes only while somebody waits for something;
paced, it is the machine's clock; the world does not know which.

Everything random is keyed by (seed, stream, index). The index is the caller's key, a sample's
name and a count, so that a sample taken again is the same sample; without one the world counts.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from cellctl.drivers.base import Image
from cellctl.geometry import Array, Transform
from cellctl.sim.camera import Capture, Stream
from cellctl.sim.glass import Glass
from cellctl.sim.motion import RING_S, Limits
from cellctl.sim.optics import Instant
from cellctl.sim.paper import Ink
from cellctl.sim.robot import HISTORY_S, Arm
from cellctl.sim.shrink import shrunk
from cellctl.sim.truth import Device, Truth

STILL_PX, STEP_PX, MOST_INSTANTS = 0.02, 0.5, 12
"""Motion in an exposure: what counts as none, how far a blur's sub-exposures are apart."""
PROBES_M = ((0.0, 0.0, 0.0), (0.4, 0.0, 0.0), (-0.4, 0.0, 0.0), (0.0, 0.25, 0.0), (0.0, -0.25, 0.0))
"""Points at the flange whose motion tells how much the bracket moves."""


@dataclass(frozen=True, eq=False)
class Exposure:
    """A dequeued frame, not rendered yet: everything that its picture depends on but noise. The
    ink is that at its exposure's end."""

    capture: Capture
    exposure_s: float
    instants: tuple[Instant, ...]
    truth: Truth
    ink: Ink


@dataclass(eq=False)
class Habits:
    """How the next strokes come out: circles with `shrink` times their radius; for `weak` of them
    the ink gives out after `share` of the way."""

    shrink: float = 1.0
    weak: int = 0
    share: float = 1.0


class World:
    """One cell, from time `t` on."""

    def __init__(self, truth: Truth, t: float = 0.0) -> None:
        self.now = t
        self._truths = [(t, truth)]
        self._counts: Counter[str] = Counter()
        self.arm = Arm(truth, t)
        self.stream = Stream(truth.preset.camera, t)
        self.glass = Glass(truth.seed, truth.preset.projector, t)
        self.habits = Habits()
        self._due: list[tuple[int, Callable[[], None]]] = []

    @property
    def truth(self) -> Truth:
        """What is true now."""
        return self._truths[-1][1]

    def advance(self, t: float) -> None:
        """Let time pass until `t`; it never goes back."""
        self.now = max(self.now, t)
        self.stream.advance(self.now)
        before = min(self.stream.oldest(self.now), self.now - HISTORY_S) - 2 * RING_S
        self.arm.forget(before)
        self.glass.forget(before)
        while len(self._truths) > 1 and self._truths[1][0] < before:
            del self._truths[0]
            self.arm.pen.forget({s.number for _, truth in self._truths for s in truth.sheets})

    def index(self, stream: str, key: str | None) -> str:
        """The index under which something random is drawn from `stream`."""
        if key is not None:
            return f"sample {key}"
        self._counts[stream] += 1
        return f"{self._counts[stream] - 1}"

    def move(self, waypoints: Array, limits: Limits, key: str | None = None) -> float:
        """Start a move through joint waypoints (n, 6); returns when it will end."""
        self._meet_due()
        return self.arm.move(self.now, waypoints, limits, self.index("move", key))

    def draw(self, waypoints: Array, limits: Limits, key: str | None = None) -> float:
        """Start a stroke through joint waypoints (n, 6); returns when it will end."""
        self._meet_due(stroke=True)
        habits = self.habits
        if habits.shrink != 1.0:
            waypoints = shrunk(self.truth, waypoints, habits.shrink)
        share = habits.share if habits.weak else 1.0
        ends = self.arm.draw(self.now, waypoints, limits, self.index("stroke", key), share)
        habits.weak = max(habits.weak - 1, 0)
        return ends

    def touch(self, waypoints: Array, limits: Limits, key: str | None = None) -> float:
        """Start a stroke that ends where the pen feels a contact; returns when it will end."""
        self._meet_due()
        return self.arm.touch(self.now, waypoints, limits, self.index("touch", key))

    def show(self, image: Image, key: str | None = None) -> float:
        """Show an image; returns the time of the acknowledgement, before it is on the glass."""
        self.glass.show(self.now, image, self.index("glass", key))
        return self.now

    def dequeue(self) -> Exposure | None:
        """The oldest frame that the camera's buffers hold."""
        capture = self.stream.dequeue()
        if capture is None:
            return None
        duration = self.truth.preset.camera.exposure_s
        truth = next(truth for since, truth in reversed(self._truths) if since <= capture.seen)
        instants = self._instants(truth, capture.seen, duration)
        ink = self.arm.pen.ink(capture.seen + duration)
        return Exposure(capture, duration, instants, truth, ink)

    def noise_index(self, exposure: Exposure, key: str | None) -> str:
        """Under which the sensor noise of an exposure's picture is drawn."""
        if exposure.capture.seen != exposure.capture.t:
            return f"hung at {exposure.capture.seen!r}"
        return self.index("sensor", key)

    def nudge(self, device: str, shift_m: Array, turn_rad: Array) -> None:
        """Move `device` ("camera" or "projector") in its own frame, from now on."""
        if device == "camera":
            moved = replace(self.truth, camera=_nudged(self.truth.camera, shift_m, turn_rad))
        else:
            moved = replace(self.truth, projector=_nudged(self.truth.projector, shift_m, turn_rad))
        self.become(moved)

    def after_strokes(self, count: int, change: Callable[[], None]) -> None:
        """Do `change` when `count` strokes have been drawn since the world began, at once if they
        have: before the next motion that begins with the pen in the air, and before the next
        stroke."""
        if self.arm.pen.strokes >= count:
            change()
        else:
            self._due.append((count, change))

    def become(self, truth: Truth) -> None:
        """From now on, `truth` is true."""
        self._truths.append((self.now, truth))
        self.arm.surround(self.now, truth)

    def _meet_due(self, *, stroke: bool = False) -> None:
        """What was planted for after some number of strokes happens now, if that is reached."""
        if not self._due or not (stroke or not self.arm.pen_is_down(self.now)):
            return
        count = self.arm.pen.strokes
        due = [change for after, change in self._due if after <= count]
        self._due = [(after, change) for after, change in self._due if after > count]
        for change in due:
            change()

    def _instants(self, truth: Truth, t: float, duration: float) -> tuple[Instant, ...]:
        """The exposure from `t` on in parts short enough that nothing moves in one."""
        probe = self.arm.frames(t + duration * np.linspace(0.0, 1.0, 5))
        moved = _motion_px(truth, probe)
        if moved < STILL_PX:
            return (Instant(1.0, probe[0], self.glass.between(t, t + duration)),)
        count = int(np.clip(np.ceil(moved / STEP_PX), 2, MOST_INSTANTS))
        edges = t + duration * np.linspace(0.0, 1.0, count + 1)
        frames = self.arm.frames((edges[:-1] + edges[1:]) / 2)
        return tuple(
            Instant(1.0 / count, frame, self.glass.between(start, end))
            for frame, start, end in zip(frames, edges[:-1], edges[1:], strict=True)
        )


def _nudged(device: Device, shift_m: Array, turn_rad: Array) -> Device:
    frame = device.pose.child
    nudge = Transform.from_rvec(frame, frame, turn_rad, shift_m)
    return replace(device, pose=device.pose @ nudge)


def _motion_px(truth: Truth, frames: Array) -> float:
    """How far, in camera pixels, the arm moves over link frames (n, 7, 4, 4) in time order."""
    flange = frames[:, -1]
    probes = np.array(PROBES_M) @ np.swapaxes(flange[:, :3, :3], 1, 2) + flange[:, None, :3, 3]
    points = np.concatenate([frames[..., :3, 3], probes], axis=1)
    way = np.linalg.norm(np.diff(points, axis=0), axis=2).sum(axis=0)
    depth = (points[0] - truth.camera.pose.translation) @ truth.camera.pose.rotation[:, 2]
    return float((way / np.maximum(depth, 0.2)).max() * truth.camera.lens.focal.max())
