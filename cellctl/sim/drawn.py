"""What has been drawn, as one who scores a run may know it."""

from __future__ import annotations

from typing import Any

import numpy as np

from cellctl.geometry import Array
from cellctl.sim.paper import Ink
from cellctl.sim.shrink import fitted_circle
from cellctl.sim.truth import Truth

LEAST_M = 1e-3
"""What is shorter is a dot and has no circle."""


def drawn(truth: Truth, ink: Ink) -> list[dict[str, Any]]:
    """Of each stroke with ink on a sheet that lies on the table: `stroke`, its number; `sheet`;
    `length_m`; `centre_m` (3,) in the world and `radius_m` of its circle, None for a dot."""
    sheets = {sheet.number: sheet for sheet in truth.sheets}
    parts: dict[tuple[int, int], list[Array]] = {}
    for line, count in ink:
        if line.stroke is not None and line.sheet in sheets:
            parts.setdefault((line.stroke, line.sheet), []).append(line.places[:count])
    return [
        {"stroke": stroke, "sheet": sheets[number].name}
        | _circle(truth, [sheets[number].on_table(places) for places in lines])
        for (stroke, number), lines in parts.items()
    ]


def _circle(truth: Truth, lines: list[Array]) -> dict[str, Any]:
    """Of table xy (n, 2) of a stroke's lines; the longest one is its figure."""
    lengths = [float(np.linalg.norm(np.diff(xy, axis=0), axis=1).sum()) for xy in lines]
    figure = lines[int(np.argmax(lengths))]
    if max(lengths) < LEAST_M:
        return {"length_m": sum(lengths), "centre_m": None, "radius_m": None}
    centre, radius = fitted_circle(figure)
    return {
        "length_m": sum(lengths),
        "centre_m": truth.table.surface(centre).tolist(),
        "radius_m": radius,
    }
