"""Runs on disk, owned by one daemon. All writing happens in one thread, in the order asked for.

<data>/lock                           held while a daemon owns the directory; holds its pid
<data>/runs/<run_id>/run.json         cellctl-run/1
                     journal.jsonl    cellctl-journal/1
                     images/*.png
                     result.json      cellctl-result/1
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import os
import shutil
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import IO, Any, ParamSpec, TypeVar

import structlog

from cellctl.drivers.base import Image
from cellctl.errors import BadInput, Busy, NotFound
from cellctl.store.calibrations import CalibrationStore
from cellctl.store.files import (
    read_document,
    storage,
    sweep,
    sync_directory,
    utc_now,
    write_document,
)
from cellctl.store.history import LIVE, History, Standing, advance, standing_of
from cellctl.store.journal import Entry, Journal, read
from cellctl.store.pictures import write_picture
from cellctl.store.run_folder import JOURNAL, RESULT, RUN, RunFolder, RunHeader, read_header

P = ParamSpec("P")
T = TypeVar("T")

UNBORN = ".new-"
LOCK = "lock"

log = structlog.get_logger(__name__)


class InOrder:
    """One thread in which blocking calls run in the order in which they were asked for."""

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="store")

    async def __call__(self, function: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> T:
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._thread, partial(function, *args, **kwargs))

    def close(self) -> None:
        self._thread.shutdown()


class RunRecord:
    """A run that is open for appending. What it has journalled is safe when `await` returns."""

    def __init__(
        self, folder: RunFolder, journal: Journal, entries: list[Entry], in_order: InOrder
    ) -> None:
        self.folder = folder
        self.history = History(folder.directory, entries)
        self._journal = journal
        self._in_order = in_order

    @property
    def header(self) -> RunHeader:
        return self.folder.header

    @property
    def directory(self) -> Path:
        return self.folder.directory

    async def append(self, kind: str, /, at: str = "", **data: Any) -> Entry:
        """Journal an event. Raises as `Journal.append`."""
        return await self._in_order(self._append, kind, data, at)

    async def append_sample(
        self, at: str, key: str, data: Mapping[str, Any], images: Mapping[str, Image]
    ) -> Entry:
        """Write the images, then journal the sample that names them. `at` is its step."""
        return await self._in_order(self._append_sample, at, key, dict(data), images)

    async def write_result(self, content: dict[str, Any]) -> None:
        """Write result.json."""
        await self._in_order(write_document, self.directory / "result.json", RESULT, content)

    def presume(self, **standing: Any) -> None:
        """Correct the standing in mind when the disk would not take the event that says so."""
        self.folder.standing = replace(self.folder.standing, **standing)

    async def close(self) -> None:
        await self._in_order(self._journal.close)

    def _append(self, kind: str, data: dict[str, Any], at: str) -> Entry:
        entry = self._journal.append(kind, data, at)
        self.history.add(entry)
        self.folder.standing = advance(self.folder.standing, entry)
        return entry

    def _append_sample(
        self, at: str, key: str, data: dict[str, Any], images: Mapping[str, Image]
    ) -> Entry:
        stem = f"{at}/{key}".replace("/", ".")
        named = {}
        for name, image in images.items():
            picture = write_picture(self.directory / "images" / f"{stem}.{name}.png", image)
            file = picture.path.relative_to(self.directory).as_posix()
            named[name] = {"file": file, "sha256": picture.sha256}
        return self._append("sample", {"key": key, "data": data, "images": named}, at)


class Store:
    """The data directory of one cell."""

    def __init__(self, directory: Path, in_order: InOrder) -> None:
        """Blocks; use `Store.open`."""
        self.directory = directory = directory.absolute()
        self.in_order = in_order
        self._runs = directory / "runs"
        with storage(directory):
            self._runs.mkdir(parents=True, exist_ok=True)
        self._lock = _lock(directory / LOCK)
        try:
            with storage(directory):
                sweep(directory)
                self.calibrations = CalibrationStore(directory)
            self._folders = self._recover()
        except BaseException:
            self._lock.close()
            raise
        self._requests = {f.header.request_id: run_id for run_id, f in self._folders.items()}

    @classmethod
    async def open(cls, directory: Path) -> Store:
        """Own the data directory; runs that a crash cut short become `interrupted`.

        Raises Busy when another daemon owns it, StorageFault when it cannot be written, BadInput
        when active.json is damaged. A damaged run does not keep the others from being opened.
        """
        in_order = InOrder()
        try:
            return await in_order(cls, directory, in_order)
        except BaseException:
            in_order.close()
            raise

    async def close(self) -> None:
        """Finish what was asked for and let go of the directory; idempotent."""
        self.in_order.close()
        self._lock.close()

    async def create(self, header: RunHeader) -> RunRecord:
        """A new run, on disk and journalled as started when this returns."""
        folder = RunFolder(self._runs / header.run_id, header)
        journal, entries = await self.in_order(_create, folder)
        folder.standing = standing_of(entries)
        self._folders[header.run_id] = folder
        self._requests[header.request_id] = header.run_id
        return RunRecord(folder, journal, entries, self.in_order)

    async def reopen(self, run_id: str, kind: str, /, **data: Any) -> RunRecord:
        """Open an existing run and journal an event. BadInput when its journal is damaged."""
        folder = self.folder(run_id)
        journal, entries = await self.in_order(Journal.open, folder.directory / JOURNAL)
        record = RunRecord(folder, journal, entries, self.in_order)
        try:
            await record.append(kind, **data)
        except BaseException:
            await record.close()
            raise
        return record

    async def note(self, run_id: str, kind: str, /, **data: Any) -> None:
        """Journal one event of a run that is not open."""
        await (await self.reopen(run_id, kind, **data)).close()

    def folder(self, run_id: str) -> RunFolder:
        """One run; NotFound names the newest ones."""
        if run_id not in self._folders:
            newest = sorted(self._folders)[-5:]
            raise NotFound(
                f"no run {run_id!r}; the newest are: {', '.join(newest) or 'none'}", known=newest
            )
        return self._folders[run_id]

    def folders(self) -> list[RunFolder]:
        """All runs, oldest first."""
        return [self._folders[run_id] for run_id in sorted(self._folders)]

    def requested(self, request_id: str) -> RunFolder | None:
        """The run that a request started, also before the daemon was restarted."""
        run_id = self._requests.get(request_id)
        return self._folders[run_id] if run_id else None

    async def result(self, run_id: str) -> dict[str, Any] | None:
        """result.json of a run that is done."""
        path = self.folder(run_id).directory / "result.json"
        if self.folder(run_id).standing.status != "done":
            return None
        return await self.in_order(read_document, path, RESULT)

    def _recover(self) -> dict[str, RunFolder]:
        for unborn in self._runs.glob(f"{UNBORN}*"):
            shutil.rmtree(unborn, ignore_errors=True)
        directories = sorted(path for path in self._runs.iterdir() if path.is_dir())
        return {path.name: _recovered(path) for path in directories}


def _create(folder: RunFolder) -> tuple[Journal, list[Entry]]:
    """The run's directory appears whole, under its name and started, or not at all."""
    directory = folder.directory
    unborn = directory.with_name(UNBORN + folder.header.run_id)
    with storage(directory), contextlib.ExitStack() as undo:
        undo.callback(shutil.rmtree, unborn, ignore_errors=True)
        _write_unborn(unborn, folder.header)
        unborn.rename(directory)
        undo.callback(shutil.rmtree, directory, ignore_errors=True)
        sync_directory(directory.parent)
        opened = Journal.open(directory / JOURNAL)
        undo.pop_all()
    return opened


def _write_unborn(unborn: Path, header: RunHeader) -> None:
    (unborn / "images").mkdir(parents=True)
    write_document(unborn / "run.json", RUN, header.model_dump())
    with contextlib.closing(Journal.create(unborn / JOURNAL, header.run_id)) as journal:
        journal.append("started", {"boot": header.boot})


def _recovered(directory: Path) -> RunFolder:
    """A run found at start. One that says it is alive was cut short: journal that."""
    try:
        header, entries = _read_own(directory)
    except BadInput as error:
        log.warning("a run is damaged", run=directory.name, error=error.message)
        return _damaged(directory, error.message)
    folder = RunFolder(directory, header, standing_of(entries))
    if folder.standing.status in LIVE:
        _interrupt(folder)
    return folder


def _read_own(directory: Path) -> tuple[RunHeader, list[Entry]]:
    """Header and entries; BadInput also when they are a copy of another run's."""
    header = read_header(directory)
    entries = read(directory / JOURNAL).intact()
    for name, run_id in (("run.json", header.run_id), ("journal", entries[0].data.get("run_id"))):
        if run_id != directory.name:
            raise BadInput(f"{directory}: its {name} is that of run {run_id!r}")
    return header, entries


def _interrupt(folder: RunFolder) -> None:
    journal, _ = Journal.open(folder.directory / JOURNAL)
    with contextlib.closing(journal):
        entry = journal.append("interrupted", {"error": "the daemon ended in the middle of it"})
    folder.standing = advance(folder.standing, entry)
    log.warning("a run was interrupted", run=folder.header.run_id)


def _damaged(directory: Path, problem: str) -> RunFolder:
    """A run that cannot be read is listed, not hidden; its files stay as they are."""
    try:
        header = read_header(directory)
    except BadInput:
        header = RunHeader(run_id="", procedure="?", request_id="", cell="?", created=utc_now())
    if header.run_id != directory.name:
        header = header.model_copy(update={"run_id": directory.name, "request_id": ""})
    return RunFolder(directory, header, Standing(status="failed", error=problem))


def _lock(path: Path) -> IO[str]:
    """Hold the lock of a data directory; Busy names who holds it."""
    with storage(path):
        file = path.open("a+")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.seek(0)
        owner = file.read(32).strip() or "?"
        file.close()
        raise Busy(
            f"{path.parent} belongs to a running daemon (pid {owner}); stop it first, or choose "
            "another data directory with CELLCTL_DATA",
            pid=owner,
        ) from None
    with storage(path), contextlib.ExitStack() as undo:
        undo.callback(file.close)
        file.truncate(0)
        file.write(f"{os.getpid()}\n")
        file.flush()
        undo.pop_all()
    return file
