"""The camera's stream: free-running exposures, late delivery, and buffers that keep old frames."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from cellctl.sim.presets import CameraPreset


@dataclass(frozen=True)
class Capture:
    """One delivered frame: number in the stream, start of its exposure, and when the light was
    really taken (`seen`: earlier when the camera hangs and repeats an old picture)."""

    sequence: int
    t: float
    seen: float


class Stream:
    """As V4L2 does: finished frames fill the buffers in order; when all are full, newer frames
    are lost until the oldest one is dequeued. So after a pause the first frame is an old one."""

    def __init__(self, preset: CameraPreset, t: float) -> None:
        self._preset, self._started = preset, t
        self._period = 1.0 / preset.frame_rate_hz
        self._full: deque[Capture] = deque()
        self._next = 0
        self._losing = 0
        self._hang: tuple[float, float] | None = None

    def advance(self, now: float) -> None:
        """Everything that was delivered until `now`."""
        delivered = self._number_at(now - self._preset.exposure_s - self._preset.delivery_s)
        while self._next <= delivered:
            if len(self._full) >= self._preset.buffers:
                self._next = delivered + 1
            elif self._losing:
                self._losing -= 1
                self._next += 1
            else:
                self._full.append(self._capture(self._next))
                self._next += 1

    def ready_at(self) -> float:
        """When the next frame can be dequeued; in the past when one waits already."""
        if self._full:
            return self._full[0].t
        number = self._next + self._losing
        return self._delivery(number)

    def dequeue(self) -> Capture | None:
        return self._full.popleft() if self._full else None

    def oldest(self, now: float) -> float:
        """Start of the oldest exposure that somebody may still ask for."""
        return min([now, *(capture.seen for capture in self._full)])

    def lose(self, count: int) -> None:
        """The next `count` frames are lost on the way."""
        self._losing = count

    def hang(self, t: float, duration: float) -> None:
        """For `duration` from `t` on, every frame shows what the camera saw at `t`."""
        self._hang = (t, t + duration)

    def _capture(self, number: int) -> Capture:
        t = self._started + number * self._period
        if self._hang and self._hang[0] <= t < self._hang[1]:
            return Capture(number, t, self._hang[0])
        return Capture(number, t, t)

    def _delivery(self, number: int) -> float:
        start = self._started + number * self._period
        return start + self._preset.exposure_s + self._preset.delivery_s

    def _number_at(self, t: float) -> int:
        """The newest exposure that has begun at `t`."""
        number = math.floor((t - self._started) / self._period)
        # Floating point must not hide a frame that `ready_at` has promised.
        return number + 1 if self._started + (number + 1) * self._period <= t + 1e-9 else number
