"""A daemon for tests of the bus: the real engine and store, procedures that only count.

`count` takes `n` samples, `pause_s` apart; `ask` waits for an answer. Run as a program it serves
until it is killed: `python -m tests.bus.toy ENDPOINT DIRECTORY`.
"""

from __future__ import annotations

import asyncio
import contextlib
import sys
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self, TypeVar

from pydantic import BaseModel, ConfigDict, Field

from cellctl.bus.server import Server
from cellctl.cell import Cell
from cellctl.config import parse_config
from cellctl.drivers import base
from cellctl.engine import Engine
from cellctl.errors import CellctlError, DeviceFault
from cellctl.gate import Gate
from cellctl.motion import guard_of
from cellctl.permission import Permission
from cellctl.run import Procedure, Result, Run
from cellctl.store import Store
from cellctl.store.sheets import SheetLedger
from tests import cells

CELL = "toy"
T = TypeVar("T")


class Count(BaseModel):
    model_config = ConfigDict(extra="forbid")
    n: int = Field(default=3, ge=0, le=2000)
    pause_s: float = Field(default=0.0, ge=0, le=1)
    verdict: str = "pass"


class Nothing(BaseModel):
    model_config = ConfigDict(extra="forbid")


async def count(run: Run, cell: Cell, params: Count) -> Result:
    await run.step("counting", params.n)
    for number in range(1, params.n + 1):
        if str(number) not in run.samples():
            await run.checkpoint()
            await asyncio.sleep(params.pause_s)
            await run.sample(str(number), {"number": number})
        run.progress(number)
    verdict: Any = params.verdict
    stages = [{"stage": "counting", "numbers": params.n}]
    reasons = [] if verdict == "pass" else ["it was asked to fail"]
    return Result(verdict, reasons, {"stages": stages, "answer": 42.0}, {"camera": [1.0]})


async def ask(run: Run, cell: Cell, params: Nothing) -> Result:
    await run.ask("is the board on?", ["yes", "no"])
    return Result("pass")


async def fault(run: Run, cell: Cell, params: Nothing) -> Result:
    raise DeviceFault("the toy's spring is broken")


async def move(run: Run, cell: Cell, params: Nothing) -> Result:
    return Result("pass")


PROCEDURES = [
    Procedure("count", "Counts.", Count, False, count),
    Procedure("ask", "Asks the operator.", Nothing, False, ask),
    Procedure("fault", "Breaks.", Nothing, False, fault),
    Procedure("move", "Would move.", Nothing, True, move),
]


class Still:
    """A robot, camera and projector that only say who they are: no procedure here uses them."""

    async def identity(self) -> base.Identity:
        return base.Identity(driver="toy", model="still")

    async def read(self) -> base.RobotState:
        raise DeviceFault("it has no joints")

    async def state_at(self, t: float) -> base.RobotState:
        raise DeviceFault("it has no joints")

    async def check(self, path: base.Path) -> None:
        raise DeviceFault("it does not move")

    async def move(self, target: base.Target, *, timeout_s: float) -> base.RobotState:
        raise DeviceFault("it does not move")

    async def draw(self, stroke: base.Stroke, *, timeout_s: float) -> base.StrokeResult:
        raise DeviceFault("it has no motors")

    async def touch(self, stroke: base.Stroke, *, timeout_s: float) -> base.RobotState:
        raise DeviceFault("it has no motors")

    async def stop(self, *, clean: bool) -> None:
        return

    async def grab(self, *, exposed_after: float) -> base.Frame:
        raise DeviceFault("it has no lens")

    async def show(self, image: base.Image) -> float:
        raise DeviceFault("it has no lamp")

    async def call(self, function: Callable[..., Any], *args: Any, timeout_s: float) -> Any:
        return function(*args)


@contextlib.asynccontextmanager
async def toy_engine(directory: Path) -> AsyncIterator[Engine]:
    document = cells.document()
    document["cell"] = {"id": CELL}
    config = parse_config(document, "toy")
    still = Still()
    guard = guard_of(config)
    store = await Store.open(directory)
    sheets = SheetLedger(directory, store.in_order)
    cell = Cell(config, guard, still, still, still, still, sheets)
    engine = Engine(cell, PROCEDURES, store, Gate(Permission(directory)))
    try:
        yield engine
    finally:
        await engine.shutdown()
        await store.close()


class Daemon:
    """A toy daemon in a thread of this process; its engine is reached by `call` and `wait`."""

    engine: Engine
    server: Server

    def __init__(self, endpoint: str, directory: Path) -> None:
        self.endpoint, self._directory = endpoint, directory
        self._ready = threading.Event()
        self._error: CellctlError | None = None
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()))

    def __enter__(self) -> Self:
        self._thread.start()
        assert self._ready.wait(10)
        if self._error:
            self._thread.join()
            raise self._error
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        self._thread.join(20)
        assert not self._thread.is_alive(), "the daemon did not close"

    def stop(self) -> None:
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._stop.set)

    def call(self, function: Callable[[], object]) -> None:
        """Call on the daemon's loop."""
        self._loop.call_soon_threadsafe(function)

    def wait(self, function: Callable[[], Awaitable[T]]) -> T:
        """Await on the daemon's loop."""

        async def run() -> T:
            return await function()

        return asyncio.run_coroutine_threadsafe(run(), self._loop).result(10)

    async def _serve(self) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        try:
            async with toy_engine(self._directory) as self.engine:
                self.server = Server(self.engine, self.endpoint, CELL, self.engine.boot)
                async with self.server:
                    self._ready.set()
                    await self._stop.wait()
        except CellctlError as error:
            self._error = error
            self._ready.set()


def store_large_calibration(daemon: Daemon) -> None:
    """As `large`, 200 kB."""
    content = {"verdict": "pass", "reasons": [], "calibration": "x" * 200_000}
    store = daemon.engine._store
    daemon.wait(lambda: store.in_order(store.calibrations.add, "large", content))


@contextmanager
def deadline(seconds: float) -> Iterator[Callable[[], bool]]:
    """`while not late(): ...` fails the test instead of hanging it."""
    end = time.monotonic() + seconds

    def late() -> bool:
        if time.monotonic() > end:
            raise AssertionError(f"not within {seconds:g} s")
        return False

    yield late


async def _main(endpoint: str, directory: str) -> None:
    async with (
        toy_engine(Path(directory)) as engine,
        Server(engine, endpoint, CELL, engine.boot),
    ):
        sys.stdout.write(f"ready {engine.boot}\n")
        sys.stdout.flush()
        await asyncio.sleep(60)


if __name__ == "__main__":
    asyncio.run(_main(*sys.argv[1:3]))
