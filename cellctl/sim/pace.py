"""How the simulated cell's time passes: with the machine's clock, or only while somebody waits."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable
from typing import Protocol

from cellctl.sim.world import World


class Pace(Protocol):
    """Moves a world's time on."""

    name: str

    def now(self) -> float:
        """The cell time; the world has been brought up to it."""
        ...

    async def wait(self, ready_at: Callable[[], float], deadline: float) -> None:
        """Until `ready_at()` (asked again whenever something happened), or `deadline`."""
        ...

    def changed(self) -> None:
        """Something happened that waiters should look at."""
        ...


class Stepped:
    """Time jumps to what is waited for, and stands still otherwise."""

    name = "stepped"

    def __init__(self, world: World) -> None:
        self._world = world

    def now(self) -> float:
        return self._world.now

    async def wait(self, ready_at: Callable[[], float], deadline: float) -> None:
        while (t := min(ready_at(), deadline)) > self._world.now:
            self._world.advance(t)

    def changed(self) -> None:
        """Nobody waits while something happens."""


class Paced:
    """Time is CLOCK_MONOTONIC, with which a real camera stamps its frames, too."""

    name = "paced"

    def __init__(self, world: World) -> None:
        self._world = world
        self._change = asyncio.Event()

    def now(self) -> float:
        self._world.advance(time.monotonic())
        return self._world.now

    async def wait(self, ready_at: Callable[[], float], deadline: float) -> None:
        while (left := min(ready_at(), deadline) - self.now()) > 0:
            change = self._change
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(left):
                    await change.wait()

    def changed(self) -> None:
        self._change.set()
        self._change = asyncio.Event()
