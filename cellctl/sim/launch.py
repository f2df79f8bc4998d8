"""Find the simulated cell of a data directory, or start it; stop it.

A world holds a lock beside its endpoint file while it lives, so a file that a killed world left
behind is never taken for a living one.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

from cellctl.config import SimulationSection
from cellctl.errors import BadInput, DeviceFault
from cellctl.sim.endpoint import Endpoint, lives, read_endpoint

READY_S = 60.0
STOP_S = 10.0
POLL_S = 0.02
DETACH = (
    "import os, sys\n"
    "os.setsid()\n"
    "if os.fork(): os._exit(0)\n"
    "os.execv(sys.executable, [sys.executable, *sys.argv[1:]])\n"
)
"""Starts its arguments as a Python process that is nobody's child and in nobody's terminal."""


def endpoint_file(data_dir: Path) -> Path:
    return data_dir / "world.json"


def connect_or_start(simulation: SimulationSection, data_dir: Path) -> Endpoint:
    """The world of `data_dir`: the one that runs there, or a new one.

    BadInput when another world than `simulation` describes runs there; DeviceFault when it does
    not start. Blocks for a second or two when it has to start one.
    """
    path = endpoint_file(data_dir)
    data_dir.mkdir(parents=True, exist_ok=True)
    running = _await_endpoint(path) if lives(path) else None
    if running is None:
        return _start(simulation, path, data_dir / "world.log")
    wanted = (simulation.preset, simulation.seed, simulation.time)
    if (running.preset, running.seed, running.time) != wanted:
        raise BadInput(
            f"in {data_dir} runs the simulated cell {running.preset!r}, seed {running.seed}, "
            f"{running.time}, not {simulation.preset!r}, seed {simulation.seed}, "
            f"{simulation.time}; stop it with `python -m cellctl.sim stop --endpoint {path}` "
            "or use another data directory"
        )
    return running


def stop_world(data_dir: Path) -> bool:
    """Stop the world of `data_dir` and wait until it is gone; False when none runs."""
    return stop_endpoint(endpoint_file(data_dir))


def stop_endpoint(path: Path) -> bool:
    """As `stop_world`, of the world that serves on the endpoint file `path`."""
    endpoint = _await_endpoint(path) if lives(path) else None
    if endpoint is None:
        return False
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError):
            os.kill(endpoint.pid, number)
        if _await_end(path):
            return True
    raise DeviceFault(f"the simulated cell (process {endpoint.pid}) does not end")


def _start(simulation: SimulationSection, path: Path, log: Path) -> Endpoint:
    command = [sys.executable, "-c", DETACH, "-m", "cellctl.sim", "serve"]
    command += ["--cell", simulation.preset, "--seed", str(simulation.seed)]
    command += ["--time", simulation.time, "--endpoint", str(path)]
    command += ["--idle-exit-s", str(simulation.idle_exit_s)]
    reading, writing = os.pipe()
    with os.fdopen(reading, "rb", buffering=0) as ready, log.open("ab") as errors:
        try:
            subprocess.run(
                command, stdin=subprocess.DEVNULL, stdout=writing, stderr=errors, check=True
            )
        finally:
            os.close(writing)
        line = _line(ready.fileno(), time.monotonic() + READY_S)
    if line is None:
        raise DeviceFault(f"the simulated cell did not start within {READY_S:.0f} s; see {log}")
    if not line:
        raise DeviceFault(f"the simulated cell did not start; its log {log} ends: {_tail(log)}")
    return read_endpoint(path)


def _line(descriptor: int, deadline: float) -> bytes | None:
    """The first line from a pipe; b"" when it was closed, None when the deadline passed."""
    text = b""
    while not text.endswith(b"\n"):
        left = deadline - time.monotonic()
        if left <= 0 or not select.select([descriptor], [], [], left)[0]:
            return None
        part = os.read(descriptor, 4096)
        if not part:
            return b""
        text += part
    return text


def _tail(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1] if lines else "(empty)"


def _await_endpoint(path: Path) -> Endpoint | None:
    """The endpoint of a world that holds the lock, which may just be starting or ending."""
    deadline = time.monotonic() + READY_S
    while lives(path):
        if path.exists():
            return read_endpoint(path)
        if time.monotonic() > deadline:
            raise DeviceFault(f"a simulated cell holds the lock of {path} but does not answer")
        time.sleep(POLL_S)
    return None


def _await_end(path: Path) -> bool:
    deadline = time.monotonic() + STOP_S
    while time.monotonic() < deadline:
        if not lives(path):
            return True
        time.sleep(POLL_S)
    return False
