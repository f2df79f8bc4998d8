"""A daemon on a simulated cell, as a person would start it, for tests that look from outside."""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cellctl.bus.client import Client
from cellctl.config import load_config
from cellctl.demo import start_daemon, write_config
from cellctl.drivers.base import RobotState
from cellctl.messages import RunInfo
from cellctl.sim.drivers import SimRobot
from cellctl.sim.endpoint import read_endpoint
from cellctl.sim.launch import endpoint_file, stop_world
from cellctl.sim.link import SimClock
from cellctl.store import sheets

QUICK: dict[str, Any] = {
    "intrinsic": {"views": 8},
    "hand_eye": {"views": 5},
    "projector": {"columns": 10, "rows": 6, "pictures": 1},
    "measure_table": {"touches": 9},
    "draw": {"spots": 6, "rounds": 2},
    "evaluate": {"circles": 6},
}
"""Parameters of a `full` that is done soon; good enough to pass."""

RUN_S = 600.0


class CellRun:
    """One data directory with its config; its daemon may die and be started again."""

    def __init__(self, folder: Path, seed: int = 0, cell: str = "cr") -> None:
        self.folder = folder
        self.config = write_config(cell, seed, folder)
        self.endpoint = load_config(self.config).bus.listen
        self.kills = 0
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start the daemon and wait until it answers."""
        self._process = start_daemon(self.config, self.folder)

    def kill(self) -> None:
        """SIGKILL, as the power switch would do it."""
        self._signal(signal.SIGKILL)
        self.kills += 1

    def terminate(self) -> int:
        """SIGTERM; the exit code."""
        return self._signal(signal.SIGTERM)

    def _signal(self, number: int) -> int:
        assert self._process is not None
        process, self._process = self._process, None
        process.send_signal(number)
        return process.wait(30)

    def log(self) -> str:
        return (self.folder / "daemon.log").read_text(errors="replace")[-4000:]

    def client(self) -> Client:
        return Client(self.endpoint)

    def finish(self, run_id: str, within_s: float = RUN_S) -> RunInfo:
        """Wait for the end of a run; AssertionError when it asks what nobody answers."""
        deadline = time.monotonic() + within_s
        with self.client() as client:
            while time.monotonic() < deadline:
                info = client.run_info(run_id)
                if info.status == "waiting":
                    raise AssertionError(f"run {run_id} asks: {info.question}")
                if info.status != "running":
                    return info
                time.sleep(0.1)
        raise AssertionError(f"run {run_id} did not end:\n{self.log()}")

    async def arm(self) -> RobotState:
        """The arm in the world, which outlives the daemon."""
        endpoint = read_endpoint(endpoint_file(self.folder))
        robot = SimRobot(endpoint, load_config(self.config), SimClock(endpoint.time))
        try:
            return await robot.read()
        finally:
            await robot.close()

    def journal(self, run_id: str) -> list[str]:
        """The complete lines of a run's journal."""
        path = self.folder / "runs" / run_id / "journal.jsonl"
        if not path.exists():
            return []
        return [line for line in path.read_text().splitlines(keepends=True) if line.endswith("\n")]

    def result(self, run_id: str) -> dict[str, Any]:
        """What result.json says, without what names the run."""
        document = json.loads((self.folder / "runs" / run_id / "result.json").read_text())
        return {key: document[key] for key in ("verdict", "reasons", "data")}

    def spots(self) -> list[dict[str, Any]]:
        """The ledger's spots on the paper that lies there."""
        document = json.loads((self.folder / sheets.FILE).read_text())
        return [spot for sheet in document["sheets"].values() for spot in sheet["spots"]]

    def close(self) -> None:
        if self._process is not None:
            self._signal(signal.SIGKILL)
        stop_world(self.folder)


@contextlib.contextmanager
def cell_run(folder: Path, seed: int = 0) -> Iterator[CellRun]:
    """A CellRun with a running daemon; nothing of it is left afterwards."""
    run = CellRun(folder, seed)
    try:
        run.start()
        yield run
    finally:
        run.close()
