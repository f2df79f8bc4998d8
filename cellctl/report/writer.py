"""Reports that are written while the daemon goes on: one after the other, in a process of their
own, so that neither a slow disk nor a crash in a library is felt by a run."""

from __future__ import annotations

import asyncio
import contextlib
from pathlib import Path

import structlog

from cellctl.errors import CellctlError
from cellctl.report.page import write_report
from cellctl.worker.child import Child

WRITE_S = 60.0

log = structlog.get_logger(__name__)


class ReportWriter:
    """Writes the reports of runs that have ended. All of it is called on the event loop."""

    def __init__(self, *, timeout_s: float = WRITE_S) -> None:
        self._timeout_s = timeout_s
        self._wanted: list[Path] = []
        self._task: asyncio.Task[None] | None = None
        self._closed = False

    def ask(self, run_directory: Path) -> None:
        """Have a report written, soon. Returns at once; what goes wrong is logged. `cellctl
        report` writes one that has not been written, as when the daemon is stopped."""
        if self._closed:
            return
        self._wanted = [path for path in self._wanted if path != run_directory] + [run_directory]
        if self._task is None or self._task.done():
            self._task = asyncio.create_task(self._write_all(), name="write reports")

    async def written(self) -> None:
        """Wait until all that was asked for is written, or logged as impossible."""
        if self._task is not None:
            await asyncio.wait({self._task})

    async def close(self) -> None:
        """Give up what is not written yet; idempotent."""
        self._closed = True
        if self._task is not None and not self._task.done():
            log.info("a report is given up; `cellctl report` writes it")
            self._task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._task

    async def _write_all(self) -> None:
        """In a process that lives as long as there is something to write."""
        while self._wanted:
            async with Child("report") as child:
                while self._wanted:
                    await self._write(child, self._wanted.pop(0))

    async def _write(self, child: Child, directory: Path) -> None:
        try:
            path = await child.call(write_report, directory, timeout_s=self._timeout_s)
        except CellctlError as error:
            log.warning("no report was written", run=directory.name, error=error.message)
        else:
            log.info("report", run=directory.name, path=str(path))
