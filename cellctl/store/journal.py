"""A run's journal: one fsynced line an event, numbered and checksummed.

    {"n": 3, "t": "2026-01-31T06:15:00.250000Z", "kind": "sample", "at": "full/hand-eye/collect",
     "data": {...}, "crc": "8d2f01c4"}                                             (on one line)

`at` is the place in the run that the event belongs to, and may be empty. `crc` is the CRC-32 of
the line without that member. A line is one write that ends with its
newline, and JSON never holds a newline inside: bytes after the last newline are an append that a
crash cut short and that nobody was told to be safe. They are moved aside, never guessed at. A
line that is complete but damaged is an error, and the others stay readable.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import re
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cellctl.errors import BadInput, StorageFault
from cellctl.store.files import (
    Schema,
    storage,
    sync_directory,
    to_json,
    utc_now,
    write_atomically,
    write_fully,
)

SCHEMA = Schema("cellctl-journal", 1)
HEADER = "journal"
HEAD = re.compile(
    rb'\{"n": (\d{1,9}), "t": "([0-9TZ:.-]+)", "kind": "([a-z]+)", "at": "([\w/-]*)", "data": \{'
)
TAIL = re.compile(rb'\}, "crc": "([0-9a-f]{8})"\}')
TAIL_BYTES = len('}, "crc": "00000000"}')


@dataclass(frozen=True)
class Entry:
    """One event: running number from 0 (the header), UTC time, kind, place, and what belongs to
    it as JSON. That is decoded when it is asked for: hundreds of runs are looked through when a
    daemon starts, and few of their samples are."""

    n: int
    time: str
    kind: str
    at: str
    body: bytes

    @functools.cached_property
    def data(self) -> dict[str, Any]:
        decoded: dict[str, Any] = json.loads(self.body)
        return decoded


@dataclass(frozen=True)
class Reading:
    """All of a journal that is readable: `damage` has a sentence for each line that is not,
    `torn` the bytes of an append that was cut short."""

    entries: list[Entry]
    damage: list[str]
    torn: bytes

    def intact(self) -> list[Entry]:
        """The entries; BadInput when a line is damaged."""
        if self.damage:
            raise BadInput("; ".join(self.damage), damage=self.damage)
        return self.entries


def encode(entry: Entry) -> bytes:
    """A line, newline included."""
    head = f'{{"n": {entry.n}, "t": "{entry.time}", "kind": "{entry.kind}", "at": "{entry.at}"'
    line = b'%s, "data": %s}' % (head.encode(), entry.body)
    return b'%s, "crc": "%08x"}\n' % (line[:-1], zlib.crc32(line))


def decode(line: bytes) -> Entry:
    """An entry from a line without its newline; ValueError says what is wrong with it."""
    tail = TAIL.fullmatch(line, max(len(line) - TAIL_BYTES, 0))
    if tail is None:
        raise ValueError("it does not end with a checksum")
    if zlib.crc32(b"}", zlib.crc32(line[: tail.start() + 1])) != int(tail[1], 16):
        raise ValueError("its checksum does not match")
    head = HEAD.match(line)
    if head is None:
        raise ValueError("it is not an event of this journal's version")
    number, time, kind, at = (part.decode() for part in head.groups())
    return Entry(int(number), time, kind, at, line[head.end() - 1 : tail.start() + 1])


def read(path: Path) -> Reading:
    """Read a journal without touching it, also while it is being written.

    Raises BadInput when it cannot be opened or has a schema of another version.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise BadInput(f"{path}: cannot be read: {error.strerror}") from None
    *lines, torn = content.split(b"\n")
    entries, damage = _entries(lines, path)
    if not entries or entries[0].kind != HEADER:
        damage.insert(0, f"{path} line 1: the journal's header is missing or damaged")
        return Reading(entries, damage, torn)
    entries = SCHEMA.accept(entries[0].data.get("schema"), entries, str(path))
    return Reading(entries, damage, torn)


def _entries(lines: list[bytes], path: Path) -> tuple[list[Entry], list[str]]:
    entries: list[Entry] = []
    damage: list[str] = []
    expected = 0
    for number, line in enumerate(lines, start=1):
        try:
            entry = decode(line)
        except ValueError as error:
            damage.append(f"{path} line {number} is damaged: {error}")
            expected += 1
            continue
        if entry.n != expected:
            damage.append(f"{path} line {number}: event {entry.n} where {expected} should be")
        entries.append(entry)
        expected = entry.n + 1
    return entries, damage


class Journal:
    """A journal that is open for appending. It blocks: one thread owns it."""

    def __init__(self, path: Path, count: int) -> None:
        with storage(path):
            self._descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC)
            self._size = os.fstat(self._descriptor).st_size
        self._path = path
        self._count = count
        self._failure: StorageFault | None = None

    @classmethod
    def create(cls, path: Path, run_id: str) -> Journal:
        """Begin a journal with its header."""
        body = to_json({"schema": SCHEMA.tag, "run_id": run_id}, str(path))
        write_atomically(path, encode(Entry(0, utc_now(), HEADER, "", body)))
        return cls(path, count=1)

    @classmethod
    def open(cls, path: Path) -> tuple[Journal, list[Entry]]:
        """Open after a crash or a clean end; a torn last line is moved to a file beside it.

        Raises BadInput when a line is damaged; the file is then left as it is.
        """
        reading = read(path)
        entries = reading.intact()
        if reading.torn:
            _move_aside(path, reading.torn, len(entries))
        return cls(path, count=len(entries)), entries

    def append(self, kind: str, data: dict[str, Any], at: str = "") -> Entry:
        """Append and fsync; returns the entry as a reader will see it. `kind` is a word of small
        letters, `at` a path of names (letters, digits, `_`, `-`).

        Raises BadInput when `data` cannot be JSON, and StorageFault when the disk refuses: the
        line is then taken back and the journal accepts no other until it is opened again.
        """
        where = f"{self._path.parent}: {kind} {at}".rstrip()
        entry = Entry(self._count, utc_now(), kind, at, to_json(data, where))
        line = encode(entry)
        if HEAD.match(line) is None:
            raise ValueError(f"{where}: a kind and a place are made of plain names")
        if self._failure is not None:
            raise StorageFault(self._failure.message, **self._failure.details)
        try:
            with storage(self._path):
                write_fully(self._descriptor, line)
                os.fsync(self._descriptor)
        except StorageFault as fault:
            self._failure = fault
            self._take_back()
            raise
        self._count += 1
        self._size += len(line)
        return entry

    def _take_back(self) -> None:
        with contextlib.suppress(OSError):  # what stays is a torn line, which readers know
            os.ftruncate(self._descriptor, self._size)

    def close(self) -> None:
        """Close; idempotent."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


def _move_aside(path: Path, torn: bytes, count: int) -> None:
    """Keep the torn bytes in a file of their own, then cut them off the journal."""
    name, again = f"{path.name}.torn-{count}", 1
    while path.with_name(name).exists():
        again += 1
        name = f"{path.name}.torn-{count}-{again}"
    write_atomically(path.with_name(name), torn)
    with storage(path):
        os.truncate(path, path.stat().st_size - len(torn))
        descriptor = os.open(path, os.O_WRONLY | os.O_CLOEXEC)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        sync_directory(path.parent)
