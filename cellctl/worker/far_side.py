"""The far side of `worker.Child`: a process that evaluates pure functions, one at a time.

Started as `python -c COMMAND PARENT_PID [MODULE...]`; the modules are imported before it says that
it is ready. Requests come in on stdin and replies leave on what was stdout; whatever
else is printed goes to stderr. It ends with its parent: at the end of its stdin, and on Linux by
a signal too, for functions that hold the interpreter's lock.

A message is `!I` parts, `!Q` length of each, then the parts: a pickle of protocol 5 and the
buffers (arrays) that it refers to, which are so never copied into the pickle.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import pickle
import signal
import struct
import sys
import threading
import traceback
from dataclasses import dataclass
from io import BufferedReader
from queue import SimpleQueue
from typing import IO, Any

from cellctl.errors import CellctlError

COMMAND = "from cellctl.worker.far_side import main; main()"
"""Not `-m`: the classes below must have the same module name on both sides."""

PR_SET_PDEATHSIG = 1
Parts = list[memoryview]


@dataclass(frozen=True)
class Returned:
    value: Any


@dataclass(frozen=True)
class Raised:
    """A deliberate error; it is raised again as itself."""

    error: CellctlError


@dataclass(frozen=True)
class Broke:
    """Anything else that the function raised."""

    summary: str
    traceback: str


def pack(value: Any) -> Parts:
    """Pickle, arrays out of band. Raises what pickle raises."""
    buffers: list[pickle.PickleBuffer] = []
    body = pickle.dumps(value, protocol=5, buffer_callback=buffers.append)
    return [memoryview(body), *(buffer.raw() for buffer in buffers)]


def unpack(parts: Parts) -> Any:
    """What was packed; arrays are writable views of the received parts."""
    return pickle.loads(parts[0], buffers=parts[1:])  # noqa: S301 - from our own child or parent


def send(stream: IO[bytes], parts: Parts) -> None:
    sizes = [part.nbytes for part in parts]
    stream.write(struct.pack(f"!I{len(sizes)}Q", len(sizes), *sizes))
    for part in parts:
        stream.write(part)
    stream.flush()


def receive(stream: BufferedReader) -> Parts:
    """The parts of the next message; EOFError when the other side is gone."""
    (count,) = struct.unpack("!I", _exactly(stream, 4))
    sizes = struct.unpack(f"!{count}Q", _exactly(stream, 8 * count))
    return [_exactly(stream, size) for size in sizes]


def _exactly(stream: BufferedReader, size: int) -> memoryview:
    view = memoryview(bytearray(size))
    filled = 0
    while filled < size:
        got = stream.readinto(view[filled:])
        if not got:
            raise EOFError
        filled += got
    return view


def evaluate(parts: Parts) -> Parts:
    """Call the function of a request; the reply is always one that can be sent."""
    try:
        function, args = unpack(parts)
        return pack(Returned(function(*args)))
    except CellctlError as error:
        return _pack_raised(error)
    except Exception as error:  # noqa: BLE001 - whatever it is, the parent is told
        return pack(_broke(error))


def _pack_raised(error: CellctlError) -> Parts:
    try:
        return pack(Raised(error))
    except Exception as problem:  # noqa: BLE001 - its details cannot be pickled
        return pack(_broke(problem))


def _broke(error: Exception) -> Broke:
    summary = "".join(traceback.format_exception_only(error)).strip()
    return Broke(summary, "".join(traceback.format_exception(error)))


def end_with(parent: int, by: signal.Signals = signal.SIGKILL) -> None:
    """Have the kernel send `by` to this process when the thread that started it ends."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, by)
    if os.getppid() != parent:  # it ended before it could be watched
        os._exit(0)


def _claim_pipes() -> tuple[BufferedReader, IO[bytes]]:
    """The request and reply streams; fds 0 and 1 are left harmless to whoever uses them."""
    requests = os.fdopen(os.dup(0), "rb")
    replies = os.fdopen(os.dup(1), "wb", buffering=1 << 16)
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    os.dup2(2, 1)
    os.close(null)
    return requests, replies


def _listen(requests: BufferedReader, queue: SimpleQueue[Parts]) -> None:
    try:
        while True:
            queue.put(receive(requests))
    except (EOFError, OSError):
        os._exit(0)


def main() -> None:
    parent, *modules = sys.argv[1:]
    end_with(int(parent))
    requests, replies = _claim_pipes()
    queue: SimpleQueue[Parts] = SimpleQueue()
    threading.Thread(target=_listen, args=(requests, queue), daemon=True).start()
    for module in modules:
        importlib.import_module(module)
    send(replies, pack(Returned(None)))
    while True:
        send(replies, evaluate(queue.get()))
