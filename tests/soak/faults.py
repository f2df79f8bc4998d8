"""Plant what can go wrong with pen and paper in whole runs, one each, and see whether it is named.

    python -m tests.soak.faults --cell cr --seed 0

Prints the verdict and the reasons of each run. The exit code is 1 if any of them does not fail, or
fails without the fault's name.
"""

from __future__ import annotations

import argparse
import asyncio
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cellctl.messages import RunInfo
from cellctl.procedures.full import FullParams
from cellctl.sim.endpoint import read_endpoint
from cellctl.sim.launch import endpoint_file
from cellctl.sim.scoring import FaultPlanter
from tests.integration.cellrun import QUICK, CellRun

RUN_S = 1800.0
ROUND = 2
"""After so many rounds it happens, unless it is there from the start."""


@dataclass(frozen=True)
class Fault:
    """`verb` of the door of faults with `arguments`, and what the verdict has to say."""

    verb: str
    arguments: dict[str, Any]
    named: str
    later: bool = True


FAULTS = {
    "pen slipped": Fault("pen.slip", {"shift_mm": [3.0, 0.0, 0.0]}, "the pen slipped by"),
    "sheet moved": Fault("sheet.move", {"sheet": "A", "shift_mm": [4.0, 3.0]}, "sheet A moved by"),
    "pen dry": Fault("pen.dry", {}, "the pen is dry"),
    "TCP off": Fault("pen.off", {"shift_mm": [6.0, 0.0, 0.0]}, "the pen stands", later=False),
    "wrong radius": Fault(
        "drawing.shrink", {"factor": 0.8}, "circles come out with a radius of", later=False
    ),
}


def strokes_before(params: FullParams) -> int:
    """How many strokes the arm has led when ROUND rounds are drawn: after each touch the pen is
    lifted by one, too."""
    return params.measure_table.touches + ROUND * params.draw.spots


def with_fault(folder: Path, cell: str, seed: int, fault: Fault, asked: dict[str, Any]) -> RunInfo:
    """A whole run with the fault."""
    run = CellRun(folder, seed, cell)
    try:
        run.start()
        arguments = dict(fault.arguments)
        if fault.later:
            arguments["after_strokes"] = strokes_before(FullParams.model_validate(asked))
        asyncio.run(plant(folder, fault.verb, arguments))
        with run.client() as client:
            run_id = client.run("full", asked).run_id
        return run.finish(run_id, RUN_S)
    finally:
        run.close()


async def plant(folder: Path, verb: str, arguments: dict[str, Any]) -> None:
    planter = FaultPlanter(read_endpoint(endpoint_file(folder)))
    try:
        await planter.plant(verb, **arguments)
    finally:
        await planter.close()


def is_named(info: RunInfo, fault: Fault) -> bool:
    return info.verdict == "fail" and any(fault.named in reason for reason in info.reasons)


def soak(cell: str, seed: int, names: Sequence[str], asked: dict[str, Any], folder: Path) -> int:
    """How many of the faults were not named."""
    missed = 0
    for name in names:
        info = with_fault(folder / name.replace(" ", "-"), cell, seed, FAULTS[name], asked)
        named = is_named(info, FAULTS[name])
        missed += not named
        said = "named" if named else "NOT NAMED"
        print(f"{name}: {info.status}, verdict {info.verdict}: {said}", flush=True)
        for reason in info.reasons or [info.error or "no reason"]:
            print(f"  {reason}", flush=True)
    return missed


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cell", default="cr")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--fault", choices=sorted(FAULTS), help="this one alone")
    parser.add_argument("--quick", action="store_true", help="with few views of the boards")
    options = parser.parse_args()
    names = [options.fault] if options.fault else list(FAULTS)
    boards = ("intrinsic", "hand_eye", "projector")
    asked: dict[str, Any] = {name: QUICK[name] for name in boards} if options.quick else {}
    with tempfile.TemporaryDirectory() as folder:
        missed = soak(options.cell, options.seed, names, asked, Path(folder))
    print(f"{options.cell}, seed {options.seed}: {len(names) - missed} of {len(names)} named")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
