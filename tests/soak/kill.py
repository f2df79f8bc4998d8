"""Kill the daemon at random instants of a run, resume, and compare with the uninterrupted run.

    python -m tests.soak.kill --kills 30 --seed 1

Prints the seed, the counts and every failure. A failure: a journalled line is lost, the run does
not show as interrupted, or the resumed run ends in anything but the reference's result, to the
last digit.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from tests.integration.cellrun import QUICK, CellRun, cell_run


def reference(folder: Path) -> tuple[dict[str, Any], float]:
    """The uninterrupted run's result, and how long it took."""
    with cell_run(folder) as cell:
        with cell.client() as client:
            started = time.monotonic()
            run_id = client.run("full", QUICK).run_id
        info = cell.finish(run_id)
        if info.status != "done":
            raise SystemExit(f"the uninterrupted run ended {info.status}: {info.error}")
        return cell.result(run_id), time.monotonic() - started


def killed(
    cell: CellRun, kills: int, span_s: float, chance: random.Random
) -> tuple[str, list[str]]:
    """One run, killed `kills` times; its id and what went wrong."""
    with cell.client() as client:
        run_id = client.run("full", QUICK).run_id
    wrong: list[str] = []
    for _ in range(kills):
        time.sleep(chance.uniform(0.0, span_s))
        cell.kill()
        before = cell.journal(run_id)
        cell.start()
        wrong += _after_restart(cell, run_id, before)
        with cell.client() as client:
            if client.run_info(run_id).status == "done":
                break
            client.resume(run_id)
    return run_id, wrong


def _after_restart(cell: CellRun, run_id: str, before: list[str]) -> list[str]:
    wrong = []
    if cell.journal(run_id)[: len(before)] != before:
        wrong.append(f"{run_id}: a journalled line was lost")
    with cell.client() as client:
        status = client.run_info(run_id).status
        if status not in ("interrupted", "done"):
            wrong.append(f"{run_id}: shows as {status} after the kill")
        if client.state().active_run:
            wrong.append(f"{run_id}: something runs after a restart without being asked to")
    return wrong


def soak(kills: int, per_run: int, seed: int, folder: Path) -> list[str]:
    """Kill `kills` times, `per_run` times in each run; all failures."""
    chance = random.Random(seed)
    expected, span_s = reference(folder / "reference")
    wrong: list[str] = []
    done = 0
    while done < kills:
        count = min(per_run, kills - done)
        with cell_run(folder / f"killed-{done:03}") as cell:
            run_id, failures = killed(cell, count, span_s / per_run, chance)
            wrong += failures
            done += cell.kills
            info = cell.finish(run_id)
            if info.status != "done":
                wrong.append(f"{run_id}: ended {info.status}: {info.error}")
            elif cell.result(run_id) != expected:
                wrong.append(f"{run_id}: another result than the uninterrupted run")
        print(f"{done} of {kills} kills, {len(wrong)} failures", flush=True)
    return wrong


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--per-run", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        wrong = soak(options.kills, options.per_run, options.seed, Path(folder))
    print(f"seed {options.seed}, {options.kills} kills, {len(wrong)} failures")
    for line in wrong:
        print(f"  {line}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
