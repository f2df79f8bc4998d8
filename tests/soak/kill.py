"""Kill the daemon at random instants of a run, resume, and compare with the uninterrupted run.

    python -m tests.soak.kill --kills 30 --seed 1

Prints the seed, the counts and every failure. A failure: a journalled line is lost, the run does
not show as interrupted, or the resumed run ends in anything but the reference's result: to the
last digit for what the boards say; for pen and paper, where the arm's measured course depends on
when it was sampled, the verdict, as many circles, and no place of the paper used twice.
"""

from __future__ import annotations

import argparse
import itertools
import math
import random
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cellctl.errors import CellctlError
from tests.integration.cellrun import QUICK, CellRun, cell_run

BOARDS = ("intrinsic", "hand-eye", "projector", "stages")


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


def killed(cell: CellRun, instants: Sequence[float]) -> tuple[str, int, list[str]]:
    """One run, killed at these seconds of its run time, which rise; its id, how many of the kills
    interrupted it, and what went wrong."""
    with cell.client() as client:
        run_id = client.run("full", QUICK).run_id
    interrupted, ran_s = 0, 0.0
    wrong: list[str] = []
    for instant in instants:
        time.sleep(instant - ran_s)
        ran_s = instant
        cell.kill()
        before = cell.journal(run_id)
        cell.start()
        wrong += _after_restart(cell, run_id, before)
        with cell.client() as client:
            if client.run_info(run_id).status == "done":
                break
            interrupted += 1
            client.resume(run_id)
    return run_id, interrupted, wrong


def differences(cell: CellRun, run_id: str, expected: dict[str, Any]) -> list[str]:
    """In what the ended run's result is not what it should be."""
    result = cell.result(run_id)
    data = result["data"]
    wrong = [f"{part} differs" for part in BOARDS if data[part] != expected["data"][part]]
    if result["verdict"] != expected["verdict"]:
        wrong.append(f"verdict {result['verdict']}: {'; '.join(result['reasons'])}")
    for part in ("draw", "evaluate"):
        count, right = (len(d.get(part, {}).get("circles", ())) for d in (data, expected["data"]))
        if count != right:
            wrong.append(f"{part}: {count} circles instead of {right}")
    return [f"{run_id}: {what}" for what in [*wrong, *_met(cell.spots())]]


def _met(spots: list[dict[str, Any]]) -> list[str]:
    """Spots that were drawn on twice."""
    return [
        f"{a['owner']} and {b['owner']} met on the paper"
        for a, b in itertools.combinations(spots, 2)
        if math.hypot(a["x"] - b["x"], a["y"] - b["y"]) < a["radius_m"] + b["radius_m"]
    ]


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
    """Interrupt runs `kills` times, each of them up to `per_run` times; all failures.

    A run that is resumed takes longer than one that is not, so some runs are killed only once: any
    instant until the very end is as likely as any other. Kills after the end do not count.
    """
    chance = random.Random(seed)
    expected, span_s = reference(folder / "reference")
    wrong: list[str] = []
    done = runs = 0
    while done < kills and runs < 4 * kills:
        runs += 1
        count = min(chance.randint(1, per_run), kills - done)
        instants = sorted(chance.uniform(0.0, span_s) for _ in range(count))
        interrupted, failures = one_run(folder / f"killed-{runs:03}", instants, expected)
        wrong += failures
        done += interrupted
        print(f"{done} of {kills} kills, {len(wrong)} failures", flush=True)
    if done < kills:
        wrong.append(f"only {done} of {kills} kills interrupted a run")
    return wrong


def one_run(
    folder: Path, instants: Sequence[float], expected: dict[str, Any]
) -> tuple[int, list[str]]:
    """How many of the kills interrupted a run, and what went wrong until its end."""
    interrupted, wrong = 0, list[str]()
    try:
        with cell_run(folder) as cell:
            run_id, interrupted, wrong = killed(cell, instants)
            info = cell.finish(run_id)
            if info.status != "done":
                wrong.append(f"{run_id}: ended {info.status}: {info.error}")
            else:
                wrong += differences(cell, run_id, expected)
    except (CellctlError, AssertionError) as error:
        at = ", ".join(f"{instant:.2f}" for instant in instants)
        wrong.append(f"{folder.name}, killed at {at} s: {type(error).__name__}: {error}")
    return interrupted, wrong


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
