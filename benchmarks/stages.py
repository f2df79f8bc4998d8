"""The demo on several seeds: verdicts, and the published pipeline's rows beside the model's.

    python -m benchmarks.stages --cell cr --seeds 0-9

Prints a line a seed, then the median true error of each row, what the numeric model of the same
world gives, and their ratio. Exit code 1 when a verdict is not `pass`, something was touched, or
one of the published rows is off by more than 30 %.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
from pathlib import Path
from typing import Any

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
    return result


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
    wrong = compare(options.cell, results)
    wrong += [f"seed {r['seed']}: {r['final']['verdict']}" for r in results if _failed(r)]
    print(f"\n{len(results)} seeds, {len(wrong)} failures")
    for line in wrong:
        print(f"  {line}")
    return 1 if wrong else 0


def _failed(result: dict[str, Any]) -> bool:
    return result["final"]["verdict"] != "pass" or result["collisions"] > 0


if __name__ == "__main__":
    sys.exit(main())
