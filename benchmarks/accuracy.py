"""How near light comes to ink in the standard world: ours, and the published pipeline beside it.

    python -m benchmarks.accuracy --cell all --seeds 0-19
    python -m benchmarks.accuracy --cell cr --plant kinematics --spots 12x5
    python -m benchmarks.accuracy --cell ir --seeds 0-4 --rendered

Without `--rendered` nothing is rendered: true geometry and Gaussian noise, solved by the product's
own solvers. Prints the true error of every seed, then medians, the worst, and each stage of the
published pipeline beside what WORLD.md's model of it gives. Without `--plant` each of the planted
worlds (kinematic error x3, bow 2 mm, draw noise 0.5 mm) follows. With `--rendered` the demo runs
on each seed instead: everything through pictures and motion, in minutes. Exit code 1 when a limit
is missed; all that are missed are listed by name.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from scipy.stats import binom

from benchmarks.published import pipelines
from benchmarks.stages import MODEL_MM, PUBLISHED, TOLERANCE, seeds
from benchmarks.world import PLANTS, ROUNDS, World, world
from cellctl.demo import run_demo
from cellctl.geometry import Array
from cellctl.procedures import refine

NOTHING, RENDERED = "nothing", "rendered"
LAYOUTS = {"60": (ROUNDS, 1), "12x5": (1, ROUNDS)}
"""Rounds of 12 spots, and how often each spot is drawn at."""
MEDIAN_MM = {
    (NOTHING, "60"): 0.20,
    (NOTHING, "12x5"): 0.24,
    (RENDERED, "60"): 0.20,
    ("kinematics", "60"): 0.50,
    ("bow", "60"): 0.30,
    ("draw-noise", "60"): 0.35,
}
"""By what is planted and how the circles are laid out."""
WORST_MM = {(NOTHING, "60"): 0.35, (RENDERED, "60"): 0.35}


@dataclass(frozen=True)
class Case:
    cell: str
    seed: int
    plant: str


@dataclass(frozen=True)
class Outcome:
    """True millimetres: `ours` by layout with the correction that was chosen, and the stages of
    the published pipeline by name."""

    case: Case
    ours: dict[str, tuple[float, str]]
    published: dict[str, float]


def measure(case: Case, layouts: list[str]) -> Outcome:
    """Record, solve and score one world."""
    found = world(case.cell, case.seed, None if case.plant == NOTHING else case.plant)
    ours = {name: _ours(found, *LAYOUTS[name]) for name in layouts}
    return Outcome(case, ours, _published(found))


def _ours(found: World, rounds: int, repeats: int) -> tuple[float, str]:
    base = found.drawing.base
    result = refine.solve(found.circles(found.spots(rounds, repeats)), base, found.adjust)
    return found.drawing.score(refine.refined(base, result)), result.chosen


def _published(found: World) -> dict[str, float]:
    """Its circles are drawn in the drawing posture, as the paper does."""
    drawn = found.spots(ROUNDS, 1)
    seen = found.pictured(drawn)
    stages = pipelines(found.data(), drawn, seen)
    grid = found.seen.grid[:, :2]
    return {name: found.seen.score(send(grid))["true_mm"] for name, send in stages.items()}


def rendered(case: Case, layouts: list[str]) -> Outcome:
    """The demo of that seed."""
    params = {"draw": {"spots": 12, "rounds": ROUNDS}}
    with tempfile.TemporaryDirectory() as folder:
        result = run_demo(case.cell, case.seed, folder=Path(folder), params=params)
    final = result["final"]
    error = float("nan") if final["true_mm"] is None else final["true_mm"]
    stages = {row["name"]: row["true_mm"] for row in result["stages"]}
    return Outcome(case, {layouts[0]: (error, final["verdict"])}, stages)


def tell(outcome: Outcome) -> None:
    ours = ", ".join(f"{name}: {mm:.3f} ({how})" for name, (mm, how) in outcome.ours.items())
    stages = " ".join(f"{mm:.2f}" for mm in outcome.published.values())
    case = outcome.case
    print(f"{case.cell} seed {case.seed:3}  {case.plant:<10}  {ours}  [{stages}]", flush=True)


def judge(cell: str, plant: str, outcomes: list[Outcome]) -> list[str]:
    """Print one cell's summary; the limits that it misses."""
    missed = []
    print(f"\n{cell}, planted: {plant}; true mm")
    for layout in outcomes[0].ours:
        errors = [outcome.ours[layout][0] for outcome in outcomes]
        missed += _limits(f"{cell}, {plant}, {layout} spots", (plant, layout), errors)
    if plant in (NOTHING, RENDERED):
        missed += _compare(cell, outcomes)
    print(flush=True)
    return missed


def _limits(name: str, kind: tuple[str, str], errors: list[float]) -> list[str]:
    missed = []
    figures = {"median": statistics.median(errors), "worst": float(np.max(errors))}
    for (word, value), limits in zip(figures.items(), (MEDIAN_MM, WORST_MM), strict=True):
        limit = limits.get(kind)
        told = "" if limit is None else f"  limit {limit:.2f}"
        print(f"  {'ours, ' + kind[1] + ' spots, ' + word:<64} {value:.3f}{told}")
        if limit is not None and not value <= limit:
            missed.append(f"{name}: {word} {value:.3f} mm, over the limit of {limit:.2f} mm")
    return missed


def _compare(cell: str, outcomes: list[Outcome]) -> list[str]:
    """The published stages beside WORLD.md's model of them. One is off when the whole interval of
    its median is: single cells differ by factors, and twenty of them tell it to a fifth."""
    missed = []
    names = list(MODEL_MM[cell])[:PUBLISHED]
    model = {name: MODEL_MM[cell][name] for name in names}
    for name in outcomes[0].published:
        values = np.array([o.published[name] for o in outcomes if name in o.published])
        told = f"  {name:<64} {np.median(values):.3f}"
        if name in model:
            ratio, (low, high) = np.median(values) / model[name], interval(values / model[name])
            told += f"  model {model[name]:.2f}, ratio {ratio:.2f} ({low:.2f} to {high:.2f})"
            if low > 1.0 + TOLERANCE or high < 1.0 - TOLERANCE:
                missed.append(f"{cell}: {name}: more than {TOLERANCE:.0%} off, {ratio:.2f} times")
        print(told)
    return missed


def interval(values: Array) -> tuple[float, float]:
    """Of the median, at 95 %, whatever the distribution: order statistics (David and Nagaraja,
    Order statistics, 2003, section 7.1)."""
    count = len(values)
    if count < 6:  # not even the extremes hold it that surely
        return 0.0, float("inf")
    skipped = max(int(binom.ppf(0.025, count, 0.5)) - 1, 0)
    ordered = np.sort(values)
    return float(ordered[skipped]), float(ordered[count - 1 - skipped])


def run(cases: Iterable[Case], options: argparse.Namespace) -> Iterator[Outcome]:
    """In the order of the cases, `jobs` at a time."""
    work = partial(rendered if options.rendered else measure, layouts=options.spots)
    if options.jobs == 1:
        yield from map(work, cases)
        return
    with ProcessPoolExecutor(options.jobs, get_context("spawn")) as pool:
        yield from pool.map(work, cases)


def main() -> int:
    options = _options()
    plants = [RENDERED] if options.rendered else options.plant
    missed = []
    for cell in options.cell:
        for plant in plants:
            outcomes = []
            for outcome in run([Case(cell, seed, plant) for seed in options.seeds], options):
                tell(outcome)
                outcomes.append(outcome)
            missed += judge(cell, plant, outcomes)
    print(f"{len(missed)} limits missed")
    for line in missed:
        print(f"  {line}")
    return 1 if missed else 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cell", default="all", choices=[*sorted(MODEL_MM), "all"])
    parser.add_argument("--seeds", type=seeds, default=seeds("0-19"))
    parser.add_argument("--spots", default="both", choices=[*LAYOUTS, "both"])
    parser.add_argument("--plant", default="all", choices=[NOTHING, *PLANTS, "all"])
    parser.add_argument("--rendered", action="store_true")
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    options.cell = sorted(MODEL_MM) if options.cell == "all" else [options.cell]
    options.spots = list(LAYOUTS) if options.spots == "both" else [options.spots]
    options.plant = [NOTHING, *PLANTS] if options.plant == "all" else [options.plant]
    if options.rendered:
        options.spots = ["60"]
    return options


if __name__ == "__main__":
    sys.exit(main())
