"""A driver's connection to the simulated cell, and the clock that its replies carry."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
from typing import Any

from cellctl.clock import MonotonicClock
from cellctl.errors import BY_CODE, CellctlError, DeviceFault
from cellctl.sim.wire import HOST, pack, read_frame

CONNECT_S = 5.0
ANSWER_S = 10.0
Reply = tuple[dict[str, Any], bytes]


class SimClock:
    """Cell time. Paced, it is the machine's monotonic clock; stepped, the newest reply's time:
    nothing passes in between."""

    def __init__(self, time: str) -> None:
        self._machine = MonotonicClock() if time == "paced" else None
        self._newest = 0.0

    def now(self) -> float:
        return self._machine.now() if self._machine else self._newest

    def saw(self, t: float) -> None:
        """A reply was stamped `t`."""
        self._newest = max(self._newest, t)


class Link:
    """One connection to one door. Opens when it is first used, and again after it was lost;
    whatever was under way when it was lost fails with a DeviceFault."""

    def __init__(self, name: str, port: int, clock: SimClock | None = None) -> None:
        self._name, self._port, self._clock = name, port, clock
        self._writer: asyncio.StreamWriter | None = None
        self._reader_task: asyncio.Task[None] | None = None
        self._numbers = itertools.count()
        self._waiting: dict[int, asyncio.Future[Reply]] = {}
        self._opening = asyncio.Lock()

    async def request(
        self, verb: str, blob: bytes = b"", *, answer_s: float = ANSWER_S, **arguments: Any
    ) -> Reply:
        """Send a request and wait for its reply, `answer_s` of real time at most.

        Raises the error that the cell replied with, or DeviceFault when it does not reply.
        """
        writer = await self._opened()
        number = next(self._numbers)
        future: asyncio.Future[Reply] = asyncio.get_running_loop().create_future()
        self._waiting[number] = future
        try:
            writer.write(pack({"id": number, "verb": verb, **arguments}, blob))
            async with asyncio.timeout(answer_s):
                header, pixels = await future
        except TimeoutError:
            raise DeviceFault(
                f"{self._name}: no answer to {verb} within {answer_s:.1f} s"
            ) from None
        finally:
            del self._waiting[number]
        if self._clock and "t" in header:
            self._clock.saw(header["t"])
        if error := header.get("error"):
            raise _error(self._name, error)
        return header, pixels

    async def close(self) -> None:
        """Idempotent."""
        if self._reader_task:
            self._reader_task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._reader_task
        if self._writer:
            self._writer.close()
            with contextlib.suppress(ConnectionError):
                await self._writer.wait_closed()
        self._writer, self._reader_task = None, None

    async def _opened(self) -> asyncio.StreamWriter:
        async with self._opening:
            if self._writer is None or self._reader_task is None or self._reader_task.done():
                await self.close()
                reader, self._writer = await self._connect()
                self._reader_task = asyncio.create_task(
                    self._read(reader), name=f"sim link {self._name}"
                )
            return self._writer

    async def _connect(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        try:
            async with asyncio.timeout(CONNECT_S):
                return await asyncio.open_connection(HOST, self._port)
        except (OSError, TimeoutError) as error:
            raise DeviceFault(
                f"{self._name}: the simulated cell does not answer on port {self._port}: {error}"
            ) from None

    async def _read(self, reader: asyncio.StreamReader) -> None:
        """Hands replies to those who wait for them; late ones nobody waits for are dropped."""
        reason = "closed"
        try:
            while True:
                header, blob = await read_frame(reader)
                future = self._waiting.get(header.get("id", -1))
                if future and not future.done():
                    future.set_result((header, blob))
        except (asyncio.IncompleteReadError, ConnectionError):
            reason = "lost"
        except CellctlError as error:
            reason = f"broken ({error.message})"
        finally:
            fault = DeviceFault(f"{self._name}: the link to the simulated cell was {reason}")
            for future in self._waiting.values():
                if not future.done():
                    future.set_exception(fault)


def _error(name: str, error: dict[str, str]) -> CellctlError:
    kind = BY_CODE.get(error["code"], DeviceFault)
    if kind is CellctlError:
        kind = DeviceFault
    return kind(f"{name}: {error['message']}")
