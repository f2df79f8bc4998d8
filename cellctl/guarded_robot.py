"""The robot that procedures get: every motion is allowed by a person and by the guard."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import numpy as np

from cellctl.config import CellConfig
from cellctl.drivers.base import Identity, Path, Robot, RobotState, Stroke, StrokeResult, Target
from cellctl.errors import MotionRefused
from cellctl.geometry import Array, invert, rotation_angle
from cellctl.motion import Guard

FLANGE_M, FLANGE_DEG = 0.02, 2.0
"""An arm's own calibration differs from its data sheet by less."""
START_RAD = 2e-3
"""How far from the beginning of a stroke the arm may stand: no path leads there."""


class GuardedRobot:
    """A Robot whose every motion is allowed by a person and by the guard, and capped in speed.

    `permission()` raises NotEnabled when motion is not allowed now.
    """

    def __init__(
        self, robot: Robot, guard: Guard, config: CellConfig, permission: Callable[[], None]
    ) -> None:
        self._robot, self.guard, self._permission = robot, guard, permission
        self._joint_speed = float(np.radians(config.robot.joint_speed_deg_s))
        self._tcp_speed = config.robot.tcp_speed_m_s

    async def identity(self) -> Identity:
        return await self._robot.identity()

    async def read(self) -> RobotState:
        return await self._robot.read()

    async def state_at(self, t: float) -> RobotState:
        return await self._robot.state_at(t)

    async def check(self, path: Path) -> None:
        """MotionRefused by the guard, from the measured joints, or by the controller."""
        state = await self._robot.read()
        await asyncio.to_thread(self.guard.check, state.joints, path)
        await self._robot.check(path)

    async def move(self, target: Target, *, timeout_s: float) -> RobotState:
        """Guarded and capped; NotEnabled or MotionRefused before anything has moved."""
        self._permission()
        if not 0.0 < target.speed <= 1.0:
            raise MotionRefused(f"speed fraction {target.speed} is not in (0, 1]")
        state = await self._standing()
        await asyncio.to_thread(self.guard.check, state.joints, target.path)
        await self._robot.check(target.path)
        speed = self._capped(state.joints, target)
        self._permission()  # it may have ended while the robot was asked
        return await self._robot.move(Target(target.path, speed), timeout_s=timeout_s)

    async def draw(self, stroke: Stroke, *, timeout_s: float) -> StrokeResult:
        """Guarded and capped, from where the stroke begins; NotEnabled or MotionRefused before
        anything has moved."""
        return await self._robot.draw(await self._ready(stroke), timeout_s=timeout_s)

    async def touch(self, stroke: Stroke, *, timeout_s: float) -> RobotState:
        """As `draw`."""
        return await self._robot.touch(await self._ready(stroke), timeout_s=timeout_s)

    async def stop(self, *, clean: bool) -> None:
        await self._robot.stop(clean=clean)

    async def _ready(self, stroke: Stroke) -> Stroke:
        self._permission()
        state = await self._standing()
        await asyncio.to_thread(self.guard.check_stroke, stroke)
        off = float(np.abs(state.joints - stroke.joints[0]).max())
        if off > START_RAD:
            raise MotionRefused(
                f"the arm stands {np.degrees(off):.2f} degrees from where the stroke begins"
            )
        await self._robot.check(Path(stroke.joints))
        self._permission()  # it may have ended while the robot was asked
        return Stroke(stroke.joints, min(stroke.speed_m_s, self._tcp_speed))

    async def _standing(self) -> RobotState:
        """The measured state at standstill; an arm that still moves, as after a lost link, is
        stopped first. MotionRefused when it goes on moving, or is not the arm of the config."""
        state = await self._robot.read()
        if state.standstill_s == 0.0:
            await self._robot.stop(clean=True)
            state = await self._robot.read()
        if state.standstill_s == 0.0:
            raise MotionRefused("the arm is moving though it was stopped; a path starts at rest")
        self._recognise(state)
        return state

    def _recognise(self, state: RobotState) -> None:
        """A guard for another arm, or for a flange that the controller has shifted, guards
        nothing."""
        expected = self.guard.arm.forward(state.joints)
        off = invert(expected) @ state.T_world_flange.matrix
        metres, turn = float(np.linalg.norm(off[:3, 3])), float(np.degrees(rotation_angle(off)))
        if metres > FLANGE_M or turn > FLANGE_DEG:
            raise MotionRefused(
                f"the controller reports its flange {1e3 * metres:.0f} mm and {turn:.1f} degrees "
                f"from where a {self.guard.arm.name} with these joints has it: another arm than "
                "the config says, or a TCP or base frame is set there; nothing has moved"
            )

    def _capped(self, start: Array, target: Target) -> float:
        tip = self.guard.tip_speed(start, target.path, self._joint_speed)
        cap = 1.0 if tip <= self._tcp_speed else self._tcp_speed / tip
        return min(target.speed, cap)
