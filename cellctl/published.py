"""The figures of the paper whose procedure this automates (its Table II), by the arm of its cells:
after refinement, on the circles that were fitted. It has no held-out figures."""

from __future__ import annotations

from typing import Any

ROWS = ("original camera", "intrinsic", "hand-eye", "projector", "refinement")

PAPER: dict[str, dict[str, Any]] = {
    "ur5": {"cell": "CR: UR5, Azure Kinect, BenQ MW550, 1.3 m", "refinement": (8.2, 3.6)},
    "irb4600-60/2.05": {
        "cell": "IR: ABB IRB 4600, Azure Kinect, Optoma DZ500, 3.3 m",
        "refinement": (3.4, 4.2),
    },
}


def figures(arm: str, row: str) -> tuple[float | None, float | None]:
    """The paper's px and mm in a row of its table for a cell with that arm; None where it has
    none."""
    px, mm = PAPER.get(arm, {}).get(row, (None, None))
    return px, mm
