"""Files that are whole or not there, that carry their schema, and errors a person can act on."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from cellctl.errors import BadInput, StorageFault

WHAT_TO_DO = {
    errno.ENOSPC: "the disk is full: free some space",
    errno.EDQUOT: "the disk quota is used up: free some space",
    errno.EFBIG: "the file would become larger than this process may write",
    errno.EROFS: "the file system is read-only: remount it or choose another data directory",
    errno.EACCES: "permission denied: check who owns the data directory",
    errno.EPERM: "permission denied: check who owns the data directory",
    errno.EIO: "the disk reports an input/output error: check it before anything else",
}


@dataclass(frozen=True)
class Schema:
    """Name and version of a file's form, written into it as `"schema": "name/version"`.

    `upgrade` turns content of the version before into this one's. None: there is none before.
    """

    name: str
    version: int
    upgrade: Callable[[Any], Any] | None = None

    @property
    def tag(self) -> str:
        return f"{self.name}/{self.version}"

    def accept(self, tag: Any, content: Any, where: str) -> Any:
        """`content` in this version; BadInput when `tag` is not one that can be read."""
        match = re.fullmatch(rf"{re.escape(self.name)}/([1-9]\d*)", str(tag))
        if match is None:
            raise BadInput(f"{where}: its schema is {tag!r}, not {self.tag!r}")
        version = int(match[1])
        if version > self.version:
            raise BadInput(
                f"{where}: written by a newer cellctl ({tag}; this one reads {self.tag}): update it"
            )
        if version == self.version:
            return content
        if version == self.version - 1 and self.upgrade is not None:
            return self.upgrade(content)
        raise BadInput(f"{where}: {tag} is too old; this cellctl reads {self.tag}")


@contextlib.contextmanager
def storage(path: Path) -> Iterator[None]:
    """Turn an OSError on `path` into a StorageFault that says what to do."""
    try:
        yield
    except OSError as error:
        advice = WHAT_TO_DO.get(error.errno or 0, error.strerror or str(error))
        raise StorageFault(f"cannot write {path}: {advice}", path=str(path)) from error


def utc_now() -> str:
    """Wall-clock time as ISO 8601 in UTC with microseconds."""
    return datetime.now(UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")


def to_json(value: Any, where: str, indent: int | None = None) -> bytes:
    """JSON in which floats survive exactly, in ASCII, which holds every string there can be: a path
    may have bytes that are not UTF-8. BadInput names `where` when a float is not finite."""
    try:
        text = json.dumps(value, allow_nan=False, default=_plain, indent=indent)
    except ValueError as error:
        raise BadInput(f"{where}: cannot be written as JSON: {error}") from None
    return text.encode()


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} cannot be written as JSON")


def write_document(path: Path, schema: Schema, content: dict[str, Any]) -> None:
    """Write a JSON object atomically, its schema first."""
    document = {"schema": schema.tag, **content}
    write_atomically(path, to_json(document, str(path), indent=1) + b"\n")


def read_document(path: Path, schema: Schema) -> dict[str, Any]:
    """Read what `write_document` wrote, in this version's form. BadInput names what is wrong."""
    try:
        document = json.loads(path.read_bytes())
    except OSError as error:
        raise BadInput(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise BadInput(f"{path}: not valid JSON: {error}") from None
    if not isinstance(document, dict):
        raise BadInput(f"{path}: must hold a JSON object")
    tag = document.pop("schema", None)
    accepted: dict[str, Any] = schema.accept(tag, document, str(path))
    return accepted


def write_atomically(path: Path, content: bytes) -> None:
    """Write so that a reader, or a crash, sees the old file or the new one, durably."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with storage(path):
        try:
            _write_and_sync(temporary, content)
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
        sync_directory(path.parent)


def _write_and_sync(path: Path, content: bytes) -> None:
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
    try:
        write_fully(descriptor, content)
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_fully(descriptor: int, content: bytes) -> None:
    """As os.write, but all of it."""
    left = memoryview(content)
    while left:
        left = left[os.write(descriptor, left) :]


def sync_directory(path: Path) -> None:
    """Make names that were created, replaced or removed in `path` durable."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sweep(directory: Path) -> None:
    """Remove temporary files that a crash of an earlier owner left in `directory`."""
    for path in directory.glob(".*.tmp"):
        path.unlink(missing_ok=True)
