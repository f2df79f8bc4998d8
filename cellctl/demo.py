"""The whole product on a simulated cell: a daemon of its own, triggered over Zenoh, then scored.

Only this module, besides the composition root, knows the simulation, and only it opens the
truth's door: daemon, procedures and solvers see what a real cell would show them.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from cellctl import published
from cellctl.bus.client import Client
from cellctl.bus.follow import Link, Update
from cellctl.bus.session import free_endpoint
from cellctl.calib.calibration import Calibration
from cellctl.config import load_config
from cellctl.errors import BadInput, CellctlError, Unreachable
from cellctl.messages import RunInfo
from cellctl.procedures.comparison import STAGE_OF
from cellctl.report import write_report
from cellctl.sim.cell_config import cell_document, to_toml
from cellctl.sim.endpoint import read_endpoint
from cellctl.sim.launch import endpoint_file, stop_world
from cellctl.sim.presets import PRESETS
from cellctl.sim.scoring import Scorer

READY_S = 60.0
END_S = 30.0
ENDING_S = 5.0
"""How long a process that has left the bus may take to end."""
HELD_OUT = ("held_out_px", "held_out_mm", "held_out_ci_mm")
SILENCE_S = 60.0
WORLD_IDLE_S = 60.0
"""After this long without a daemon the world of a demo that was killed ends by itself."""
FOLDER = Path("demo-data")
LOG = "daemon.log"
SERVE = (
    "import signal, sys\n"
    "from cellctl.worker.far_side import end_with\n"
    "end_with(int(sys.argv.pop(1)), signal.SIGTERM)\n"
    "from cellctl.__main__ import main\n"
    "sys.exit(main())\n"
)
"""`cellctl serve`, which ends as by SIGTERM when the process that started it ends, however."""


def run_demo(
    cell: str,
    seed: int,
    *,
    folder: Path | None = None,
    follow: Callable[[Update], None] = lambda _: None,
    procedure: str = "full",
    params: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Calibrate the simulated cell `cell` of `seed`, unattended; the record stays in `folder`.

    Returns what `cellctl demo --json` prints. Raises BadInput (unknown cell), Unreachable (the
    daemon did not start or died) and what the run failed with.
    """
    if cell not in PRESETS:
        raise BadInput(f"no simulated cell {cell!r}; there are: {', '.join(sorted(PRESETS))}")
    started = time.monotonic()
    folder = (folder or FOLDER / f"{cell}-{seed}-{datetime.now(UTC):%Y%m%dT%H%M%S}").absolute()
    config = write_config(cell, seed, folder)
    try:
        with daemon(config, folder) as process, Client(_endpoint(config)) as client:
            check = partial(_require_alive, process, folder / LOG)
            info = _run(client, procedure, params or {}, follow, check)
            result = asyncio.run(score(info, _calibration(client, info), folder))
    finally:
        stop_world(folder)
    return {
        "cell": cell,
        "seed": seed,
        **result,
        "report": str(_report(Path(info.directory), result)),
        "paper": published.PAPER.get(PRESETS[cell].arm),
        "samples": info.samples,
        "run": info.run_id,
        "record": info.directory,
        "wall_s": round(time.monotonic() - started, 1),
    }


def _report(run: Path, result: dict[str, Any]) -> Path:
    """The run's report, with what is true beside what was measured."""
    rows = {
        row["row"]: {"true_px": row["true_px"], "true_mm": row["true_mm"]}
        for row in result["table"]
    }
    final = {key: result["final"][key] for key in ("true_px", "true_mm")}
    truth = run / "report" / "truth.json"
    truth.parent.mkdir(exist_ok=True)
    truth.write_text(json.dumps({"rows": rows, "final": final}), encoding="utf-8")
    return write_report(run)


def write_config(cell: str, seed: int, folder: Path) -> Path:
    """The cell's TOML as an integrator would write it for this seed, on a free port."""
    document = cell_document(PRESETS[cell], seed)
    document["bus"] = {"listen": free_endpoint()}
    document["simulation"]["idle_exit_s"] = WORLD_IDLE_S
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "cell.toml"
    path.write_text(to_toml(document), encoding="utf-8")
    return path


def start_daemon(config: Path, folder: Path) -> subprocess.Popen[bytes]:
    """A daemon process that serves `config` with its data in `folder`, ready to be asked.

    Its log goes to `daemon.log` in `folder`. Unreachable when it does not get ready. It ends with
    the thread that calls this.
    """
    log = folder / LOG
    with log.open("ab") as sink:
        process = subprocess.Popen(
            [sys.executable, "-c", SERVE, str(os.getpid()), "serve", str(config)],
            stdout=sink,
            stderr=sink,
            env={**os.environ, "CELLCTL_DATA": str(folder)},
            start_new_session=True,
        )
    try:
        _await_ready(process, _endpoint(config), log)
    except BaseException:
        process.kill()
        process.wait()
        raise
    return process


@contextlib.contextmanager
def daemon(config: Path, folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """As `start_daemon`, stopped at the end of the block."""
    process = start_daemon(config, folder)
    try:
        yield process
    finally:
        _end(process)


def _endpoint(config: Path) -> str:
    return load_config(config).bus.listen


def _await_ready(process: subprocess.Popen[bytes], endpoint: str, log: Path) -> None:
    deadline = time.monotonic() + READY_S
    while time.monotonic() < deadline:
        _require_alive(process, log, within_s=0.0)
        with contextlib.suppress(CellctlError), Client(endpoint) as client:
            client.state()
            return
    raise Unreachable(f"the daemon was not ready within {READY_S:.0f} s; see {log}")


def _end(process: subprocess.Popen[bytes]) -> None:
    process.send_signal(signal.SIGTERM)
    try:
        process.wait(END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _require_alive(process: subprocess.Popen[bytes], log: Path, within_s: float = ENDING_S) -> None:
    """Unreachable when the daemon's process has ended, or does so within that time."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(within_s)
    if process.returncode is not None:
        last = log.read_text(errors="replace").strip().splitlines()[-1:]
        raise Unreachable(
            f"the daemon ended with code {process.returncode}; its log {log} ends: {''.join(last)}"
        )


def _run(
    client: Client,
    procedure: str,
    params: dict[str, Any],
    follow: Callable[[Update], None],
    check: Callable[[], None],
) -> RunInfo:
    """The run, ended. `check` is called when the daemon has left the bus."""
    accepted = client.run(procedure, params, request_id=f"demo-{uuid.uuid4().hex[:16]}")
    for update in client.watch(accepted.run_id, give_up_s=SILENCE_S):
        follow(update)
        if isinstance(update, Link) and not update.alive:
            check()
        if isinstance(update, RunInfo):
            break
    info = client.run_info(accepted.run_id)
    if info.status == "done" and info.verdict == "pass" and info.calibration_id:
        client.promote(info.calibration_id)
    return info


def _calibration(client: Client, info: RunInfo) -> Calibration | None:
    """What came of the run, whatever its verdict."""
    if info.calibration_id is None:
        return None
    document = client.calibration(info.calibration_id).document
    return Calibration.from_dict(document["calibration"], info.calibration_id)


async def score(info: RunInfo, calibration: Calibration | None, folder: Path) -> dict[str, Any]:
    """The tables and the final figures, scored against the truth of the world in `folder`."""
    data = (info.result or {}).get("data") or {}
    scorer = Scorer(read_endpoint(endpoint_file(folder)))
    try:
        grid = await scorer.grid()
        stages = [
            {
                "name": stage["name"],
                "training_px": stage["training_px"],
                "held_out_px": stage["held_out_px"],
                **await scorer.score(_staged(stage).project(grid)),
            }
            for stage in data.get("stages", [])
        ]
        true: dict[str, Any] = {"true_px": None, "true_mm": None}
        if calibration is not None:
            true = dict(await scorer.score(calibration.project(grid)))
        collisions = await scorer.collisions()
    finally:
        await scorer.close()
    judged = {key: data.get("evaluate", {}).get(key) for key in HELD_OUT}
    verdict = {"verdict": info.verdict or info.status, "reasons": info.reasons or _why(info)}
    return {
        "table": _table(data.get("table", []), stages, true),
        "stages": stages,
        "final": judged | true | verdict,
        "collisions": len(collisions),
    }


def _table(
    rows: list[dict[str, Any]], stages: list[dict[str, Any]], final: dict[str, Any]
) -> list[dict[str, Any]]:
    """The rows of the paper's Table II with what is true of them."""
    by_name = {stage["name"]: stage for stage in stages}
    table = []
    for row in rows:
        true = by_name.get(STAGE_OF.get(row["row"], ""), final)
        table.append({**row, "true_px": true["true_px"], "true_mm": true["true_mm"]})
    return table


def _staged(stage: dict[str, Any]) -> Calibration:
    return Calibration.from_dict(stage["calibration"], stage["name"])


def _why(info: RunInfo) -> list[str]:
    return [info.error] if info.error else []
