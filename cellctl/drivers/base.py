"""What a procedure may know of a device: three protocols and the values that pass through them.

Time stamps are `cell.clock` seconds. Every verb is bounded: it returns when what its docstring
calls "done" holds, or raises DeviceFault. Cancelling a call leaves the device safe.
"""

from __future__ import annotations

from contextvars import ContextVar
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cellctl.geometry import Array, Transform

Image = NDArray[np.uint8]
"""(height, width) grey or (height, width, 3) BGR."""

SAMPLE: ContextVar[str] = ContextVar("cellctl_sample", default="")
"""Name of the sample that is being taken. Drivers may put it into their logs; the simulated ones
key their noise by it, so that a sample taken again after a crash is the same sample."""


@dataclass(frozen=True)
class Identity:
    """Who a device says it is; recorded with every run."""

    driver: str
    model: str
    serial: str = ""
    version: str = ""


@dataclass(frozen=True, eq=False)
class RobotState:
    """A measured state. `joints` (6,) rad, `speeds` (6,) rad/s, `T_world_flange` as reported by
    the controller. `standstill_s` is for how long all joint speeds have been zero (0: moving)."""

    t: float
    joints: Array
    speeds: Array
    T_world_flange: Transform
    standstill_s: float


@dataclass(frozen=True, eq=False)
class Path:
    """Joint waypoints (n, 6) rad, after the measured joints, connected by straight joint lines."""

    waypoints: Array


@dataclass(frozen=True, eq=False)
class Target:
    """A guarded path and the fraction (0, 1] of the configured speed at which to follow it."""

    path: Path
    speed: float = 1.0


@dataclass(frozen=True, eq=False)
class Stroke:
    """A line that the pen follows without stopping: joints (n, 6) rad, at most a millimetre of
    the tip apart, from where the arm stands still. `speed_m_s` is that of the tip, as commanded."""

    joints: Array
    speed_m_s: float


@dataclass(frozen=True, eq=False)
class StrokeResult:
    """How a stroke was followed: measured joints (k, 6) at times `t` (k,), and the settled state
    at its end."""

    t: Array
    joints: Array
    state: RobotState


@dataclass(frozen=True, eq=False)
class Frame:
    """A camera picture: its exposure started at `t` and lasted `exposure_s`."""

    image: Image
    t: float
    exposure_s: float
    sequence: int


class Robot(Protocol):
    async def identity(self) -> Identity: ...

    async def read(self) -> RobotState:
        """The newest state."""
        ...

    async def state_at(self, t: float) -> RobotState:
        """The state at cell time `t`, interpolated; DeviceFault when `t` is not covered."""
        ...

    async def check(self, path: Path) -> None:
        """MotionRefused when the controller would not follow `path`. Never moves."""
        ...

    async def move(self, target: Target, *, timeout_s: float) -> RobotState:
        """Follow the path; done when the arm stands still at its end by measured joint speed."""
        ...

    async def draw(self, stroke: Stroke, *, timeout_s: float) -> StrokeResult:
        """Follow the stroke; done when the arm stands still at its end. DeviceFault when it was
        not followed to its end: what was drawn of it is then unknown."""
        ...

    async def touch(self, stroke: Stroke, *, timeout_s: float) -> RobotState:
        """Follow the stroke until the tool feels a contact, and stop there. Returns the state at
        which the contact was felt; DeviceFault when none was felt until the stroke's end."""
        ...

    async def stop(self, *, clean: bool) -> None:
        """Stop and wait for standstill; idempotent, from any state. `clean` follows the path's
        deceleration, a defensive stop uses the hardest one."""
        ...


class Camera(Protocol):
    async def identity(self) -> Identity: ...

    async def grab(self, *, exposed_after: float) -> Frame:
        """The first picture whose whole exposure lies after cell time `exposed_after`."""
        ...


class Projector(Protocol):
    async def identity(self) -> Identity: ...

    async def show(self, image: Image) -> float:
        """Show an image of the projector's size; returns the cell time from which it is surely
        on the glass (measured latency and margin included)."""
        ...
