"""A small engine that lives in memory, and a daemon around it, for tests of the bus.

Its procedures count: `count` takes `n` steps of `pause_s`; `ask` waits for an answer; `broken`
raises what nobody foresaw. Run as a program it serves until it is killed.
"""

from __future__ import annotations

import asyncio
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Self

from cellctl.bus.requests import Published
from cellctl.bus.server import Server
from cellctl.errors import BadInput, Busy, CellctlError, NotFound
from cellctl.messages import (
    Accepted,
    AckRequest,
    CalibrationInfo,
    CancelRequest,
    Event,
    Events,
    ProcedureInfo,
    Procedures,
    Progress,
    PromoteRequest,
    Question,
    ResumeRequest,
    RunAccepted,
    RunInfo,
    RunRequest,
    Runs,
    State,
)


class ToyEngine:
    """One run at a time, idempotent by request id, forgetful at the end of the process."""

    def __init__(self, cell: str, boot: str) -> None:
        self.cell, self.boot = cell, boot
        self.known: dict[str, RunInfo] = {}
        self.requests: dict[str, str] = {}
        self.active: str | None = None
        self.stuck = asyncio.Event()
        self._events: list[Event] = []
        self._callbacks: list[Callable[[Published], None]] = []
        self._task: asyncio.Task[None] | None = None
        self._answer: asyncio.Future[str] | None = None
        self._state_seq = 0

    def state(self) -> State:
        self._state_seq += 1
        run = self.known[self.active] if self.active else None
        return State(
            cell=self.cell,
            boot=self.boot,
            seq=self._state_seq,
            phase="idle" if run is None else "waiting" if run.question else "running",
            active_run=self.active,
            procedure=run.procedure if run else None,
            progress=run.progress if run else None,
            question=run.question if run else None,
            simulated=True,
            wall_time=time.time(),
        )

    def events(self, since: int) -> Events:
        return Events(boot=self.boot, events=[e for e in self._events if e.seq > since])

    def procedures(self) -> Procedures:
        names = ("count", "ask", "broken")
        return Procedures(
            procedures=[
                ProcedureInfo(name=name, summary="a toy", moves=False, params={}) for name in names
            ]
        )

    def subscribe(self, callback: Callable[[Published], None]) -> Callable[[], None]:
        self._callbacks.append(callback)
        return lambda: self._callbacks.remove(callback)

    def event(self, kind: str, run_id: str | None = None, **data: object) -> None:
        event = Event(
            boot=self.boot,
            seq=len(self._events) + 1,
            kind=kind,
            wall_time=time.time(),
            run_id=run_id,
            data=data,
        )
        self._events.append(event)
        self._publish(event)
        self._publish(self.state())

    def _publish(self, message: Published) -> None:
        for callback in self._callbacks:
            callback(message)

    async def start(self, procedure: str, request: RunRequest) -> RunAccepted:
        if known := self.requests.get(request.request_id):
            return RunAccepted(run_id=known, boot=self.boot, replayed=True)
        if procedure == "broken":
            raise KeyError("nobody foresaw this")
        if procedure not in ("count", "ask"):
            raise NotFound(f"no procedure {procedure!r}; known: count, ask, broken")
        if self.active:
            raise Busy(f"run {self.active} is active", active_run=self.active)
        run_id = f"r{len(self.known) + 1:04d}"
        self.requests[request.request_id] = run_id
        self.known[run_id] = RunInfo(
            run_id=run_id, procedure=procedure, status="running", started="now"
        )
        self.active = run_id
        self._task = asyncio.create_task(self._run(self.known[run_id], request))
        return RunAccepted(run_id=run_id, boot=self.boot)

    async def _run(self, run: RunInfo, request: RunRequest) -> None:
        self.event("run_started", run.run_id, procedure=run.procedure)
        try:
            await (self._ask(run) if run.procedure == "ask" else self._count(run, request))
            run.status, run.verdict = "done", "pass"
            run.result = {"answer": 42.0}
        except asyncio.CancelledError:
            run.status = "cancelled"
        self.active = None
        self.event("run_ended", run.run_id, status=run.status)

    async def _count(self, run: RunInfo, request: RunRequest) -> None:
        total, pause_s = int(request.params.get("n", 3)), request.params.get("pause_s", 0.01)
        for done in range(1, total + 1):
            await asyncio.sleep(pause_s)
            run.samples = done
            run.progress = Progress(run_id=run.run_id, step="counting", done=done, total=total)
            self._publish(run.progress)
            self.event("sample", run.run_id, number=done)

    async def _ask(self, run: RunInfo) -> None:
        self._answer = asyncio.get_running_loop().create_future()
        run.question = Question(text="is the board on?", choices=["yes", "no"])
        run.status = "waiting"
        self.event("question", run.run_id)
        answer = await self._answer
        run.question, run.status = None, "running"
        self.event("answered", run.run_id, answer=answer)

    async def resume(self, request: ResumeRequest) -> RunAccepted:
        raise BadInput(f"run {request.run_id} has ended; only an interrupted one can be resumed")

    async def cancel(self, request: CancelRequest) -> Accepted:
        if not self.active or not self._task or request.run_id not in (None, self.active):
            raise NotFound("no such run is active")
        self._task.cancel()
        return Accepted(message="cancelling", run_id=self.active)

    async def ack(self, request: AckRequest) -> Accepted:
        if self._answer is None or self._answer.done():
            raise BadInput("nothing waits for an answer")
        self._answer.set_result(request.answer)
        return Accepted(message="answered")

    async def promote(self, request: PromoteRequest) -> Accepted:
        if request.calibration_id == "stuck":
            await self.stuck.wait()
        raise NotFound(f"no calibration {request.calibration_id!r}")

    async def run_info(self, run_id: str) -> RunInfo:
        if run_id not in self.known:
            raise NotFound(f"no run {run_id!r}")
        return self.known[run_id]

    async def runs(self) -> Runs:
        return Runs(runs=list(self.known.values()))

    async def calibration(self, calibration_id: str) -> CalibrationInfo:
        document = {"size": "x" * 200_000} if calibration_id == "large" else {"camera": [1.0]}
        return CalibrationInfo(calibration_id=calibration_id, active=True, document=document)

    async def close(self) -> None:
        self.stuck.set()
        if self._task:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)


class Daemon:
    """A toy daemon in a thread of this process. `call` runs a function on its loop."""

    def __init__(self, endpoint: str, cell: str = "toy", boot: str = "boot-1") -> None:
        self.endpoint, self.cell, self.boot = endpoint, cell, boot
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
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(20)
        assert not self._thread.is_alive(), "the daemon did not close"

    def call(self, function: Callable[[], object]) -> None:
        self._loop.call_soon_threadsafe(function)

    async def _serve(self) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        self.engine = ToyEngine(self.cell, self.boot)
        self.server = Server(self.engine, self.endpoint, self.cell, self.boot)
        try:
            async with self.server:
                self._ready.set()
                await self._stop.wait()
                await self.engine.close()
        except CellctlError as error:
            self._error = error
            self._ready.set()


@contextmanager
def deadline(seconds: float) -> Iterator[Callable[[], bool]]:
    """`while not late(): ...` fails the test instead of hanging it."""
    end = time.monotonic() + seconds

    def late() -> bool:
        if time.monotonic() > end:
            raise AssertionError(f"not within {seconds:g} s")
        return False

    yield late


async def _main(endpoint: str, cell: str, boot: str) -> None:
    engine = ToyEngine(cell, boot)
    async with Server(engine, endpoint, cell, boot):
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        await asyncio.sleep(60)


if __name__ == "__main__":
    asyncio.run(_main(*sys.argv[1:4]))
