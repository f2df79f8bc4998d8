"""The simulated cell's devices, as `drivers.base` wants them; each has a connection of its own."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Coroutine
from functools import partial
from typing import Any

import numpy as np

from cellctl.config import CellConfig
from cellctl.drivers.base import (
    SAMPLE,
    Frame,
    Identity,
    Image,
    Path,
    RobotState,
    Stroke,
    StrokeResult,
    Target,
)
from cellctl.errors import BadInput, DeviceFault
from cellctl.geometry import Array, Transform
from cellctl.sim.endpoint import Endpoint
from cellctl.sim.link import ANSWER_S, Link, SimClock

SLICES_S = {"paced": 0.05, "stepped": 0.5}
"""Cell time of one wait for the arm; what a stop may have to wait for."""
STANDSTILL_S = 0.1
"""All measured joint speeds zero for this long is standstill: an arm that rings slowly passes
through zero, too."""
GOAL_RAD = 1e-3
STOP_S = 5.0
FRAME_WAIT_S = 1.0
FRAME_PATIENCE_S = 3.0
"""How much later than expected a frame may come, in cell time."""


class Tally:
    """Names requests by the sample that is being taken and a count within it."""

    def __init__(self) -> None:
        self._name, self._count = "", 0

    def next(self) -> dict[str, Any]:
        """Arguments for the next request; none when no sample is being taken."""
        name = SAMPLE.get()
        if name != self._name:
            self._name, self._count = name, 0
        if not name:
            return {}
        self._count += 1
        return {"sample": {"name": name, "count": self._count - 1}}


class SimRobot:
    """The simulated arm."""

    def __init__(self, endpoint: Endpoint, config: CellConfig, clock: SimClock) -> None:
        self._link = Link("robot", endpoint.cell, clock)
        self._config, self._tally = config.robot, Tally()
        self._slice_s = SLICES_S[endpoint.time]
        self._feels_contact = config.bracket.pen.feels_contact

    async def identity(self) -> Identity:
        header, _ = await self._link.request("hello")
        return Identity("sim", header["arm"], f"{header['preset']}-{header['seed']}", "1")

    async def read(self) -> RobotState:
        header, _ = await self._link.request("robot.read")
        return _state(header)

    async def state_at(self, t: float) -> RobotState:
        header, _ = await self._link.request("robot.read_at", at=t)
        return _state(header)

    async def check(self, path: Path) -> None:
        await self._link.request("robot.check", waypoints=path.waypoints.tolist())

    async def move(self, target: Target, *, timeout_s: float) -> RobotState:
        """As `Robot.move`. Cancelled or too late, it has stopped the arm when it returns.

        `timeout_s` is cell time, and real time on top of what one answer may take. DeviceFault
        on a protective stop, a lost link, a timeout, or when the arm rests somewhere else.
        """
        state = await self._carried_out(partial(self._start, target), timeout_s)
        _check_goal(state, target.path.waypoints[-1])
        return state

    async def draw(self, stroke: Stroke, *, timeout_s: float) -> StrokeResult:
        """As `Robot.draw`, with the care of `move`; measured at 125 Hz."""
        state = await self._follow("robot.draw", stroke, timeout_s)
        _check_goal(state, stroke.joints[-1])
        _, blob = await self._link.request("robot.followed")
        rows = np.frombuffer(blob).copy().reshape(-1, 1 + stroke.joints.shape[1])
        return StrokeResult(rows[:, 0], rows[:, 1:], state)

    async def touch(self, stroke: Stroke, *, timeout_s: float) -> RobotState:
        """As `Robot.touch`, with the care of `move`. The arm stands still at the contact."""
        if not self._feels_contact:
            raise DeviceFault(
                "robot: this cell's pen cannot feel a contact (bracket.pen.feels_contact is false)"
            )
        await self._follow("robot.touch", stroke, timeout_s)
        header, _ = await self._link.request("robot.felt")
        if header["felt"] is None:
            raise DeviceFault("robot: no contact was felt until the end of the way")
        return _state(header["felt"])

    async def stop(self, *, clean: bool) -> None:
        await self._link.request("robot.stop", hard=not clean)
        try:
            await self._settled(STOP_S, faults=False)
        except TimeoutError as error:
            raise DeviceFault(f"robot: after a stop, {error}") from None

    async def close(self) -> None:
        await self._link.close()

    async def _follow(self, verb: str, stroke: Stroke, timeout_s: float) -> RobotState:
        return await self._carried_out(partial(self._start_stroke, verb, stroke), timeout_s)

    async def _carried_out(
        self, start: Callable[[], Awaitable[None]], timeout_s: float
    ) -> RobotState:
        """Start a motion and wait for its end; cancelled or too late, the arm has been stopped."""
        try:
            await start()
            return await self._settled(timeout_s)
        except asyncio.CancelledError:
            await _finished(self.stop(clean=True))
            raise
        except TimeoutError as error:
            await self.stop(clean=True)
            raise DeviceFault(f"robot: {error}; the arm was stopped") from None

    async def _start(self, target: Target) -> None:
        config = self._config
        await self._link.request(
            "robot.move",
            waypoints=target.path.waypoints.tolist(),
            joint_speed_rad_s=np.radians(config.joint_speed_deg_s) * target.speed,
            joint_acceleration_rad_s2=np.radians(config.joint_acceleration_deg_s2),
            tool_speed_m_s=config.tcp_speed_m_s,
            **self._tally.next(),
        )

    async def _start_stroke(self, verb: str, stroke: Stroke) -> None:
        config = self._config
        await self._link.request(
            verb,
            joints=stroke.joints.tolist(),
            speed_m_s=min(stroke.speed_m_s, config.tcp_speed_m_s),
            joint_speed_rad_s=np.radians(config.joint_speed_deg_s),
            joint_acceleration_rad_s2=np.radians(config.joint_acceleration_deg_s2),
            **self._tally.next(),
        )

    async def _settled(self, timeout_s: float, *, faults: bool = True) -> RobotState:
        """Wait for standstill, in slices; DeviceFault on a fault, TimeoutError when too late."""
        real = time.monotonic() + timeout_s + ANSWER_S
        began: float | None = None
        while True:
            header, _ = await self._link.request(
                "robot.wait", standstill_s=STANDSTILL_S, timeout_s=self._slice_s
            )
            if header["standstill_s"] >= STANDSTILL_S:
                if faults and header["fault"]:
                    raise DeviceFault(f"robot: {header['fault']}")
                return _state(header)
            began = header["t"] if began is None else began
            if header["t"] - began > timeout_s or time.monotonic() > real:
                raise TimeoutError(f"no standstill within {timeout_s:.1f} s")


class SimCamera:
    """The simulated camera."""

    def __init__(self, endpoint: Endpoint, config: CellConfig, clock: SimClock) -> None:
        self._link, self._tally = Link("camera", endpoint.cell, clock), Tally()
        self._size = config.camera.image_size_px

    async def identity(self) -> Identity:
        header, _ = await self._link.request("hello")
        width, height = header["camera_px"]
        return Identity("sim", f"{width}x{height}", f"{header['preset']}-{header['seed']}", "1")

    async def grab(self, *, exposed_after: float) -> Frame:
        """As `Camera.grab`: buffers hold old frames, which are drained by their time stamps."""
        sample, late, real = self._tally.next(), None, float("inf")
        while True:
            header, _ = await self._link.request("camera.dequeue", timeout_s=FRAME_WAIT_S)
            frame, now = header["frame"], header["t"]
            if frame and frame["t"] >= exposed_after:
                break
            if late is None:
                late = max(exposed_after, now) + FRAME_PATIENCE_S
                real = time.monotonic() + late - now + ANSWER_S
            if now > late or time.monotonic() > real:
                raise DeviceFault(
                    f"camera: no frame that was exposed after t = {exposed_after:.3f} s came "
                    f"until t = {now:.3f} s"
                )
        header, pixels = await self._link.request("camera.picture", **sample)
        image = np.frombuffer(pixels, dtype=np.uint8).reshape(header["shape"])
        self._check(image)
        return Frame(image, frame["t"], frame["exposure_s"], frame["sequence"])

    async def close(self) -> None:
        await self._link.close()

    def _check(self, image: Image) -> None:
        height, width = image.shape[:2]
        if (width, height) != self._size:
            raise DeviceFault(
                f"camera: pictures are {width} x {height} pixels, the config says "
                f"{self._size[0]} x {self._size[1]}"
            )


class SimProjector:
    """The simulated projector."""

    def __init__(self, endpoint: Endpoint, config: CellConfig, clock: SimClock) -> None:
        self._link, self._tally = Link("projector", endpoint.cell, clock), Tally()
        self._config = config.projector

    async def identity(self) -> Identity:
        header, _ = await self._link.request("hello")
        width, height = header["projector_px"]
        return Identity("sim", f"{width}x{height}", f"{header['preset']}-{header['seed']}", "1")

    async def show(self, image: Image) -> float:
        """As `Projector.show`. BadInput when the image has not the projector's size or is not
        uint8."""
        width, height = self._config.size_px
        if image.dtype != np.uint8 or image.shape not in ((height, width), (height, width, 3)):
            raise BadInput(
                f"projector: an image is ({height}, {width}) or ({height}, {width}, 3) uint8, "
                f"not {image.shape} {image.dtype}"
            )
        header, _ = await self._link.request(
            "projector.show", image.tobytes(), shape=list(image.shape), **self._tally.next()
        )
        return float(header["shown"]) + self._config.latency_s

    async def close(self) -> None:
        await self._link.close()


def _check_goal(state: RobotState, goal: Array) -> None:
    missed = float(np.abs(state.joints - goal).max())
    if missed > GOAL_RAD:
        raise DeviceFault(
            f"robot: the arm stands {np.degrees(missed):.2f} degrees from its goal; "
            "something else stopped it"
        )


def _state(header: dict[str, Any]) -> RobotState:
    return RobotState(
        t=header["at"],
        joints=np.array(header["joints"]),
        speeds=np.array(header["speeds"]),
        T_world_flange=Transform("world", "flange", header["T_world_flange"]),
        standstill_s=header["standstill_s"],
    )


async def _finished(cleanup: Coroutine[Any, Any, None]) -> None:
    """Run `cleanup` to its end, however often the caller is cancelled meanwhile; it is bounded."""
    task = asyncio.ensure_future(cleanup)
    while not task.done():
        try:
            await asyncio.shield(task)
        except asyncio.CancelledError:
            if task.cancelled():
                raise
    task.result()
