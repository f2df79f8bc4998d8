"""The one supervisor of child processes. A child runs pure functions outside the event loop.

A child is spawned, never forked. It runs one call at a time, within a deadline; whatever goes
wrong with the process is a DeviceFault, and the next call gets a fresh process.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from io import BufferedReader
from pathlib import Path
from typing import IO, Any, Self, cast

import structlog

from cellctl.errors import CellctlError, DeviceFault
from cellctl.worker.far_side import COMMAND, Broke, Parts, Raised, pack, receive, send, unpack

START_S = 30.0
EXIT_S = 2.0
REAP_S = 5.0
DEATHS_ALLOWED = 5
DEATHS_WINDOW_S = 60.0
LAST_LINES = 20
LINE_LIMIT = 10_000

ONE_THREAD = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENCV_FOR_THREADS_NUM": "1",
}
"""Results are the same to the last digit only with one thread, and two cores have to do."""

log = structlog.get_logger(__name__)


class CallFailed(CellctlError):
    """A function raised, in a child, what it should not. `details["traceback"]` is the child's."""


class Child:
    """A supervised child process that evaluates pure functions.

    It is started by the first call (or `start`), and lives until `close`. `preload` names modules
    that it imports before its first call, outside of that call's deadline.
    """

    def __init__(self, name: str = "solver", *, preload: Sequence[str] = ()) -> None:
        self._name = name
        self._preload = tuple(preload)
        self._one_at_a_time = asyncio.Lock()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix=f"child-{name}")
        self._process: _Process | None = None
        self._deaths: deque[float] = deque(maxlen=DEATHS_ALLOWED)
        self._closed = False

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    @property
    def pid(self) -> int | None:
        """Of the process, while there is one."""
        return self._process.pid if self._process else None

    async def start(self) -> None:
        """Start the process now, if it does not run. DeviceFault when it does not get ready."""
        async with self._one_at_a_time:
            await self._running()

    async def call(self, function: Callable[..., Any], *args: Any, timeout_s: float) -> Any:
        """`function(*args)`, evaluated in the child. Both must be picklable, the function by name.

        Raises the CellctlError that the function raised, as itself; CallFailed for any other
        exception of it; DeviceFault, which names function and cause, when it took longer than
        `timeout_s` or its process died. Cancelling the call kills the process.
        """
        what = f"{function.__module__}.{getattr(function, '__qualname__', function)}"
        if function.__module__ == "__main__":
            raise ValueError(f"{what}: a child can only import functions of a module")
        request = pack((function, args))
        async with self._one_at_a_time:
            process = await self._running()
            reply = await self._within(timeout_s, process, process.exchange, request, what=what)
        return _unwrap(reply, what)

    async def close(self) -> None:
        """Kill the process, also in the middle of a call. Idempotent."""
        self._closed = True
        if self._process is not None:
            self._process.kill()
        async with self._one_at_a_time:
            await self._discard()
            self._thread.shutdown()

    async def _running(self) -> _Process:
        self._refuse_when_closed()
        if self._process is not None and (death := self._process.death()):
            log.error("child process died", child=self._name, death=death)
            self._deaths.append(time.monotonic())
            await self._discard()
        if self._process is None:
            self._refuse_too_many_deaths()
            self._process = await self._launch()
        self._refuse_when_closed()
        return self._process

    async def _launch(self) -> _Process:
        started = time.monotonic()
        self._process = process = await self._spawn()
        await self._within(START_S, process, process.wait_ready, what="its start")
        log.info(
            "child process is ready",
            child=self._name,
            pid=process.pid,
            seconds=round(time.monotonic() - started, 3),
        )
        return process

    async def _spawn(self) -> _Process:
        """Start a process, which takes milliseconds; it is not lost when that is cancelled."""
        loop = asyncio.get_running_loop()
        future = loop.run_in_executor(self._thread, _Process, self._name, self._preload)
        try:
            await _finish(future)
        except asyncio.CancelledError:
            if future.exception() is None:
                self._process = future.result()
                await self._discard()
            raise
        return future.result()

    async def _within(
        self,
        timeout_s: float,
        process: _Process,
        blocking: Callable[..., Any],
        *args: Any,
        what: str,
    ) -> Any:
        """The value of `blocking(*args)`, which ends when the process does."""
        future = asyncio.get_running_loop().run_in_executor(self._thread, blocking, *args)
        try:
            done, _ = await asyncio.wait({future}, timeout=timeout_s)
        except asyncio.CancelledError:
            await self._abandon(future)
            raise
        if not done:
            await self._abandon(future)
            self._deaths.append(time.monotonic())
            raise DeviceFault(
                f"{what} did not end within {timeout_s:g} s; process {self._name!r} was killed",
                function=what,
                timeout_s=timeout_s,
            )
        try:
            return future.result()
        except (EOFError, OSError):
            raise await self._fault(process, what) from None

    async def _fault(self, process: _Process, what: str) -> DeviceFault:
        """What to raise when the process hung up: how it ended, not that it was reaped."""
        loop = asyncio.get_running_loop()
        death = await loop.run_in_executor(self._thread, process.last_breath)
        await self._discard()
        if self._closed:
            return DeviceFault(f"process {self._name!r} was closed during {what}")
        self._deaths.append(time.monotonic())
        last = f"; its last words: {process.last_line}" if process.last_line else ""
        return DeviceFault(
            f"process {self._name!r} {death} during {what}{last}", function=what, death=death
        )

    async def _abandon(self, future: asyncio.Future[Any]) -> None:
        """Kill the process; the thread that waits for it is free when this returns."""
        if self._process is not None:
            self._process.kill()
        future.add_done_callback(_look_at)
        await self._discard()

    async def _discard(self) -> None:
        """Reap the process, in the thread and so after what still runs there; not cancellable."""
        if self._process is None:
            return
        process, self._process = self._process, None
        process.kill()
        loop = asyncio.get_running_loop()
        await _finish(loop.run_in_executor(self._thread, process.reap))

    def _refuse_when_closed(self) -> None:
        if self._closed:
            raise DeviceFault(f"process {self._name!r} is closed")

    def _refuse_too_many_deaths(self) -> None:
        horizon = time.monotonic() - DEATHS_WINDOW_S
        if len(self._deaths) == DEATHS_ALLOWED and self._deaths[0] > horizon:
            raise DeviceFault(
                f"process {self._name!r} died {DEATHS_ALLOWED} times within {DEATHS_WINDOW_S:g} s; "
                "it is not started again before that is over. Look into the log for the reason"
            )


def _unwrap(reply: Parts, what: str) -> Any:
    answer = unpack(reply)
    if isinstance(answer, Raised):
        raise answer.error
    if isinstance(answer, Broke):
        log.error("a call failed in a child", function=what, traceback=answer.traceback)
        raise CallFailed(f"{what} failed: {answer.summary}", traceback=answer.traceback)
    return answer.value


def _look_at(future: asyncio.Future[Any]) -> None:
    """Take note of an outcome that nobody waits for any more."""
    if not future.cancelled():
        future.exception()


async def _finish(future: asyncio.Future[Any]) -> None:
    """Wait for a future to the end, even when cancelled meanwhile; then be cancelled."""
    cancelled: asyncio.CancelledError | None = None
    while not future.done():
        try:
            await asyncio.shield(future)
        except asyncio.CancelledError as error:
            cancelled = error
    if cancelled is not None:
        raise cancelled


class _Process:
    """One process of a Child. All but `kill` and `death` block; one thread owns them."""

    def __init__(self, name: str, preload: Sequence[str]) -> None:
        command = [sys.executable, "-P", "-X", "faulthandler", "-c", COMMAND]
        path = os.pathsep.join(entry or str(Path.cwd()) for entry in sys.path)
        try:
            self._popen = subprocess.Popen(
                [*command, str(os.getpid()), *preload],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                env={**os.environ, **ONE_THREAD, "PYTHONPATH": path, "PYTHONUNBUFFERED": "1"},
                start_new_session=True,  # Ctrl-C in a terminal is the daemon's business
            )
        except OSError as error:
            raise DeviceFault(f"process {name!r} cannot be started: {error}") from error
        self._stdin = cast("IO[bytes]", self._popen.stdin)
        self._stdout = cast("BufferedReader", self._popen.stdout)
        self._stderr = cast("IO[bytes]", self._popen.stderr)
        self._last_lines: deque[str] = deque(maxlen=LAST_LINES)
        self._forwarder = threading.Thread(
            target=self._forward, args=(name,), name=f"stderr-{name}"
        )
        self._forwarder.start()

    @property
    def pid(self) -> int:
        return self._popen.pid

    @property
    def last_line(self) -> str:
        """The last thing that it said on stderr."""
        return self._last_lines[-1] if self._last_lines else ""

    def wait_ready(self) -> None:
        receive(self._stdout)

    def exchange(self, request: Parts) -> Parts:
        """Send a request and wait for its reply; EOFError or OSError when the process dies."""
        send(self._stdin, request)
        return receive(self._stdout)

    def death(self) -> str:
        """How it ended, in words; empty while it lives."""
        code = self._popen.poll()
        if code is None:
            return ""
        return f"died by {_signal_name(-code)}" if code < 0 else f"exited with code {code}"

    def last_breath(self) -> str:
        """As `death`, of a process that hung up and so is about to end by itself."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._popen.wait(EXIT_S)
        return self.death() or "hung up without ending"

    def kill(self) -> None:
        """SIGKILL to it and to what it may have started; harmless when it is gone."""
        if self._popen.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._popen.pid, signal.SIGKILL)

    def reap(self) -> None:
        try:
            self._popen.wait(REAP_S)
        except subprocess.TimeoutExpired:
            log.critical("child process cannot be killed", pid=self.pid)
        self._forwarder.join(REAP_S)
        for stream in (self._stdin, self._stdout, self._stderr):
            with contextlib.suppress(OSError):  # unsent bytes of a broken pipe
                stream.close()

    def _forward(self, name: str) -> None:
        while line := self._stderr.readline(LINE_LIMIT):
            text = line.decode(errors="replace").rstrip()
            if text:
                self._last_lines.append(text)
                log.info(text, child=name, pid=self.pid)


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
