"""What the sessions of a simulated cell's doors know and share."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any

from cellctl.sim import requests as form
from cellctl.sim.grid import Grid
from cellctl.sim.optics import Renderer
from cellctl.sim.pace import Pace
from cellctl.sim.robot import Reading
from cellctl.sim.world import Exposure, World

Answer = tuple[dict[str, Any], bytes]
Handler = Callable[["Session", Any], Awaitable[Answer]]
Door = dict[str, tuple[type[form.Request], Handler]]
"""Verb -> the request's form, the function that answers it."""
OK: Answer = ({}, b"")


@dataclass(eq=False)
class Slowness:
    """The next `count` replies come `seconds` late."""

    seconds: float = 0.0
    count: int = 0


@dataclass(eq=False)
class Cell:
    """What all sessions of all doors share. `render` runs a function in the render thread."""

    world: World
    pace: Pace
    renderer: Renderer
    render: Callable[..., Awaitable[Any]]
    drop_robot_links: Callable[[], None]
    slowness: Slowness = field(default_factory=Slowness)
    controller: Session | None = None
    """Whose connection moves the arm."""

    def __post_init__(self) -> None:
        self.grid = Grid(self.world.truth)


@dataclass(eq=False)
class Session:
    """One connection: what it sent last, what it has dequeued but not fetched."""

    cell: Cell
    blob: bytes = b""
    held: Exposure | None = None
    uses_robot: bool = False


def state(reading: Reading) -> dict[str, Any]:
    """A reading as it is sent."""
    return {
        "at": reading.t,
        "joints": reading.joints.tolist(),
        "speeds": reading.speeds.tolist(),
        "T_world_flange": reading.flange.tolist(),
        "standstill_s": reading.standstill_s,
        "fault": reading.fault,
    }
