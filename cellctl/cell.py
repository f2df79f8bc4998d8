"""The cell as a procedure sees it: guarded devices, the clock, the solver, what the config says."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from cellctl.config import CellConfig
from cellctl.drivers.base import Camera, Projector, Robot
from cellctl.motion import Guard
from cellctl.store.sheets import SheetLedger


class Solver(Protocol):
    """Runs pure functions outside the event loop's process."""

    async def call(self, function: Callable[..., Any], *args: Any, timeout_s: float) -> Any: ...


@dataclass(frozen=True, eq=False)
class Cell:
    """`robot` is the guarded one: every path that reaches a driver has passed `guard`. `sheets`
    knows where the paper is used up."""

    config: CellConfig
    guard: Guard
    robot: Robot
    camera: Camera
    projector: Projector
    solver: Solver
    sheets: SheetLedger
