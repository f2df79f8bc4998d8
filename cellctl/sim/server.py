"""The process around a world: three doors on loopback and one render thread.

It outlives whoever started it, as a real cell does, and ends on SIGTERM or when nobody has been
connected for a while.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import structlog

from cellctl.errors import BadInput, CellctlError
from cellctl.sim.doors import DOORS, answer
from cellctl.sim.endpoint import Endpoint, write_endpoint
from cellctl.sim.optics import Renderer
from cellctl.sim.pace import Paced, Stepped
from cellctl.sim.presets import PRESETS
from cellctl.sim.session import Cell, Session
from cellctl.sim.truth import draw
from cellctl.sim.wire import HOST, BrokenFrame, pack, read_frame
from cellctl.sim.world import World

LINGER_S = 1.0
log = structlog.get_logger("cellctl.sim")


@dataclass(frozen=True)
class Settings:
    preset: str
    seed: int
    time: Literal["stepped", "paced"]
    endpoint_file: Path
    idle_exit_s: float


class Server:
    """Serves one world until it is told to stop."""

    def __init__(self, settings: Settings) -> None:
        if settings.preset not in PRESETS:
            raise BadInput(f"unknown cell {settings.preset!r}; known: {', '.join(PRESETS)}")
        self._settings = settings
        self._sessions: dict[asyncio.Task[Any], tuple[Session, asyncio.StreamWriter]] = {}
        self._last_used = time.monotonic()
        self._stop = asyncio.Event()
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="render")
        self._cell = self._make_cell()

    async def run(self, ready: Callable[[Endpoint], None]) -> None:
        """Open the doors, say where they are, serve; returns after SIGTERM, SIGINT or idling."""
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self._stop.set)
        doors = {door: await self._open(door) for door in DOORS}
        endpoint = self._endpoint(doors)
        write_endpoint(self._settings.endpoint_file, endpoint)
        try:
            ready(endpoint)
            log.info("serving", **asdict(endpoint))
            await self._until_stopped()
        finally:
            self._settings.endpoint_file.unlink(missing_ok=True)
            await self._close(list(doors.values()))
            log.info("stopped")

    def _make_cell(self) -> Cell:
        preset = PRESETS[self._settings.preset]
        paced = self._settings.time == "paced"
        truth = draw(preset, self._settings.seed)
        world = World(truth, time.monotonic() if paced else 0.0)
        renderer = Renderer(truth.seed, preset.camera)
        pace = Paced(world) if paced else Stepped(world)
        return Cell(world, pace, renderer, self._render, self._drop_robot_links)

    def _endpoint(self, doors: dict[str, asyncio.Server]) -> Endpoint:
        ports = {door: server.sockets[0].getsockname()[1] for door, server in doors.items()}
        return Endpoint(
            pid=os.getpid(),
            cell=ports["cell"],
            truth=ports["truth"],
            faults=ports["faults"],
            preset=self._settings.preset,
            seed=self._settings.seed,
            time=self._settings.time,
        )

    async def _open(self, door: str) -> asyncio.Server:
        return await asyncio.start_server(partial(self._connected, door), HOST, 0)

    async def _until_stopped(self) -> None:
        """Waits for the stop, or for `idle_exit_s` without a connection."""
        idle = self._settings.idle_exit_s
        while not self._stop.is_set():
            left = self._last_used + idle - time.monotonic() if not self._sessions else idle
            if left <= 0:
                log.info("nobody was connected", seconds=idle)
                return
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(left):
                    await self._stop.wait()

    async def _close(self, doors: list[asyncio.Server]) -> None:
        for door in doors:
            door.close()
        tasks = list(self._sessions)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        self._thread.shutdown()

    async def _connected(
        self, door: str, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        task, session = asyncio.current_task(), Session(self._cell)
        assert task is not None
        self._sessions[task] = session, writer
        try:
            await self._converse(door, session, reader, writer)
        except (asyncio.IncompleteReadError, ConnectionError):
            log.info("disconnected", door=door)
        finally:
            del self._sessions[task]
            self._last_used = time.monotonic()
            self._let_go(session)
            writer.close()

    async def _converse(
        self,
        door: str,
        session: Session,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
    ) -> None:
        while True:
            header: dict[str, Any] = {}
            try:
                header, blob = await read_frame(reader)
                reply, pixels = await answer(door, session, header, blob)
            except CellctlError as error:
                reply, pixels = {"error": {"code": error.code, "message": error.message}}, b""
                if isinstance(error, BrokenFrame):
                    writer.write(self._frame(header, reply, pixels))
                    await _drained(reader, writer)
                    return
            except (asyncio.IncompleteReadError, ConnectionError):
                raise
            except Exception as error:
                log.exception("a request failed", door=door, verb=header.get("verb"))
                message = f"the simulated cell failed: {type(error).__name__}: {error}"
                reply, pixels = {"error": {"code": "internal", "message": message}}, b""
            await self._be_slow(door)
            writer.write(self._frame(header, reply, pixels))
            await writer.drain()

    def _frame(self, header: dict[str, Any], reply: dict[str, Any], pixels: bytes) -> bytes:
        number = header.get("id")
        known = number if isinstance(number, int) else None
        return pack({"id": known, "t": self._cell.pace.now(), **reply}, pixels)

    async def _be_slow(self, door: str) -> None:
        slowness = self._cell.slowness
        if door == "cell" and slowness.count > 0:
            slowness.count -= 1
            await asyncio.sleep(slowness.seconds)

    def _let_go(self, session: Session) -> None:
        """The arm stops when the connection that moves it drops."""
        cell = self._cell
        if cell.controller is session:
            cell.controller = None
            cell.world.arm.stop(cell.pace.now(), hard=False)
            cell.pace.changed()

    def _drop_robot_links(self) -> None:
        for session, writer in list(self._sessions.values()):
            if session.uses_robot:
                writer.transport.abort()

    async def _render(self, function: Callable[..., Any], *args: Any) -> Any:
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._thread, function, *args)


async def _drained(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Close our side and wait a little for the other one: a hard close would lose the reply."""
    writer.write_eof()
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(LINGER_S):
            while await reader.read(1 << 16):
                pass
