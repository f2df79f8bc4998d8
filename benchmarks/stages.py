"""The demo on several seeds: verdicts, and the published pipeline's rows beside the model's.

    python -m benchmarks.stages --cell cr --seeds 0-9

Prints two lines a seed, then the median true error of each row, what the numeric model of the same
world gives, and their ratio; and how often the interval on circles that no fit has seen holds the
true error. Exit code 1 when a verdict is not `pass`, the true error is 0.6 mm or more, something
was touched, one of the published rows is off by more than 30 %, or the intervals hold too rarely.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
from pathlib import Path
from typing import Any

from scipy import stats

from cellctl.demo import run_demo

MODEL_MM = {
    "cr": {
        "no distortion model": 8.3,
        "factory K, D; homography on raw pixels": 1.54,
        "calibrated K, D; homography on raw pixels": 1.36,
        "undistorted before the homography, closed-form hand-eye (Park)": 0.76,
        "hand-eye by reprojection": 0.69,
        "projector radial distortion": 0.65,
    },
    "ir": {
        "no distortion model": 5.5,
        "factory K, D; homography on raw pixels": 2.04,
        "calibrated K, D; homography on raw pixels": 1.73,
        "undistorted before the homography, closed-form hand-eye (Park)": 1.55,
        "hand-eye by reprojection": 0.90,
        "projector radial distortion": 0.75,
    },
}
"""Median true mm of the numeric model: 40 seeds, corner noise 0.07 px, nothing rendered."""
PUBLISHED = 5
TOLERANCE = 0.30
TRUE_MM = 0.6
RATE, UNLIKELY = 0.95, 0.05
"""Of the intervals; fewer hits than chance gives once in twenty times are too few."""


def seeds(text: str) -> list[int]:
    """`0-9` or `3,5,8`."""
    first, _, last = text.partition("-")
    return list(range(int(first), int(last) + 1)) if last else [int(s) for s in text.split(",")]


def one(cell: str, seed: int) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:  # a run's 4K pictures are hundreds of megabytes
        result = run_demo(cell, seed, folder=Path(folder))
    final = result["final"]
    rows = " ".join(f"{row['true_mm']:6.2f}" for row in result["stages"])
    print(
        f"seed {seed:3}  {final['verdict']:<6} {rows}  touched {result['collisions']}  "
        f"{result['samples']} samples  {result['wall_s']:.0f} s  {'; '.join(final['reasons'])}",
        flush=True,
    )
    if held(result) is not None:
        low, high = final["held_out_ci_mm"]
        print(
            f"          held out {final['held_out_mm']:.3f} mm, 95 %: {low:.3f} to {high:.3f}; "
            f"true {final['true_mm']:.3f} mm",
            flush=True,
        )
    return result


def held(result: dict[str, Any]) -> bool | None:
    """Whether the interval holds the true error; None when there is none."""
    final = result["final"]
    if final["held_out_ci_mm"] is None or final["true_mm"] is None:
        return None
    low, high = final["held_out_ci_mm"]
    return bool(low <= final["true_mm"] <= high)


def proof(results: list[dict[str, Any]]) -> list[str]:
    """Print what the circles that no fit has seen are worth; what is wrong with it."""
    wrong = [
        f"seed {result['seed']}: true error {result['final']['true_mm']} mm"
        for result in results
        if not (result["final"]["true_mm"] or TRUE_MM) < TRUE_MM
    ]
    hits = [hit for hit in map(held, results) if hit is not None]
    print(f"\nthe interval holds the true error in {sum(hits)} of {len(hits)} runs")
    if hits and stats.binom.cdf(sum(hits), len(hits), RATE) < UNLIKELY:
        wrong.append(f"only {sum(hits)} of {len(hits)} intervals hold the true error")
    return wrong


def compare(cell: str, results: list[dict[str, Any]]) -> list[str]:
    """Print the table; what is wrong with it."""
    wrong = []
    print(f"\n{'median true mm':<64} here  model  ratio")
    for i, (name, model) in enumerate(MODEL_MM[cell].items()):
        values = [result["stages"][i]["true_mm"] for result in results if result["stages"]]
        median = statistics.median(values)
        print(f"{name:<64} {median:.2f}   {model:.2f}   {median / model:.2f}")
        if i < PUBLISHED and abs(median / model - 1.0) > TOLERANCE:
            wrong.append(f"{name}: off by more than {TOLERANCE:.0%}")
    return wrong


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cell", default="cr", choices=sorted(MODEL_MM))
    parser.add_argument("--seeds", type=seeds, default=seeds("0-9"))
    options = parser.parse_args()
    results = [one(options.cell, seed) for seed in options.seeds]
    wrong = compare(options.cell, results) + proof(results)
    wrong += [f"seed {r['seed']}: {r['final']['verdict']}" for r in results if _failed(r)]
    print(f"\n{len(results)} seeds, {len(wrong)} failures")
    for line in wrong:
        print(f"  {line}")
    return 1 if wrong else 0


def _failed(result: dict[str, Any]) -> bool:
    return result["final"]["verdict"] != "pass" or result["collisions"] > 0


if __name__ == "__main__":
    sys.exit(main())
