"""Where a simulated cell can be reached: its endpoint file, and the lock that says it lives."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from cellctl.errors import BadInput, Busy

SCHEMA = "cellctl-sim/1"
LOCK_TRIES, LOCK_RETRY_S = 10, 0.05


@dataclass(frozen=True)
class Endpoint:
    """The ports of a world's doors on loopback, and which world it is; the file's content."""

    pid: int
    cell: int
    truth: int
    faults: int
    preset: str
    seed: int
    time: str
    schema: str = SCHEMA


def read_endpoint(path: Path) -> Endpoint:
    """BadInput when the file is missing or not an endpoint file of this version."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        values = {field.name: document[field.name] for field in fields(Endpoint)}
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise BadInput(f"{path}: not the endpoint file of a simulated cell: {error!r}") from None
    if values["schema"] != SCHEMA:
        raise BadInput(f"{path}: its schema is {values['schema']!r}, not {SCHEMA!r}")
    return Endpoint(**values)


def write_endpoint(path: Path, endpoint: Endpoint) -> None:
    """Readers see the whole file or none."""
    temporary = path.with_name(f"{path.name}.{os.getpid()}")
    temporary.write_text(json.dumps(asdict(endpoint)) + "\n", encoding="utf-8")
    temporary.replace(path)


@contextlib.contextmanager
def only_one(path: Path) -> Iterator[None]:
    """Holds the lock beside an endpoint file; Busy when another world holds it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with _lock_file(path).open("a") as lock:
        for _ in range(LOCK_TRIES):  # somebody who looks whether a world lives holds it briefly
            with contextlib.suppress(OSError):
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            time.sleep(LOCK_RETRY_S)
        else:
            raise Busy(f"a simulated cell runs already on {path}")
        yield


def lives(path: Path) -> bool:
    """Whether a living world holds the lock; a file that a killed one left behind says nothing."""
    try:
        with _lock_file(path).open("r+") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except BlockingIOError:
        return True
    return False


def _lock_file(path: Path) -> Path:
    return path.with_name(path.name + ".lock")
