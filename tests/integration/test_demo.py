"""`cellctl demo` that is stopped, or loses its daemon: nothing hangs and nothing is left."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from cellctl.bus.client import Client
from cellctl.config import load_config
from cellctl.errors import CellctlError
from cellctl.sim.launch import stop_world
from tests.conftest import processes_with

READY_S = 40.0
END_S = 20.0


@dataclass
class Demo:
    """`cellctl demo --json` in a process of its own, in the middle of its run."""

    process: subprocess.Popen[str]
    folder: Path
    mark: str

    def pid_of_daemon(self) -> int:
        return int((self.folder / "lock").read_text())

    def left(self, *, but: str = "-") -> list[str]:
        """What it has started and still runs a while later, commands with `but` left out."""
        end = time.monotonic() + END_S
        while left := [line for line in processes_with(self.mark) if f" {but} " not in line]:
            if time.monotonic() > end:
                break
            time.sleep(0.05)
        return left


@pytest.fixture
def demo(tmp_path) -> Iterator[Demo]:
    mark = uuid.uuid4().hex
    process = subprocess.Popen(
        [sys.executable, "-m", "cellctl", "demo", "--json"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "DEMO": mark},
    )
    folder: Path | None = None
    try:
        folder = running(tmp_path)
        yield Demo(process, folder, mark)
    finally:
        process.kill()
        process.communicate()
        if folder is not None:
            stop_world(folder)


def running(directory: Path) -> Path:
    """The demo's folder, when its run has begun."""
    end = time.monotonic() + READY_S
    while time.monotonic() < end:
        for config in directory.glob("demo-data/*/cell.toml"):
            with contextlib.suppress(CellctlError), Client(load_config(config).bus.listen) as cell:
                if cell.state().active_run:
                    return config.parent
        time.sleep(0.1)
    raise AssertionError("the demo did not start its run")


def test_sigterm_ends_the_demo_its_daemon_and_its_world(demo):
    demo.process.send_signal(signal.SIGTERM)
    out, _ = demo.process.communicate(timeout=60)
    assert (demo.process.returncode, out) == (143, "")
    assert demo.left() == []


def test_the_daemon_ends_with_a_demo_that_is_killed(demo):
    demo.process.kill()
    demo.process.wait()
    assert demo.left(but="cellctl.sim") == []
    assert "interrupted" in next(demo.folder.glob("runs/*/journal.jsonl")).read_text()


def test_a_demo_whose_daemon_dies_says_so(demo):
    os.kill(demo.pid_of_daemon(), signal.SIGKILL)
    out, _ = demo.process.communicate(timeout=60)
    assert demo.process.returncode == 5
    error = json.loads(out)["error"]
    assert "the daemon ended with code -9" in error["message"]
    assert str(demo.folder / "daemon.log") in error["message"]
    assert demo.left() == []
