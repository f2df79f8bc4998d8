"""How good the calibration is where nothing was measured: the predicted error over the table, what
causes it, what would lower it, and how it fell as data came in."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from markupsafe import Markup

from cellctl.geometry import Array
from cellctl.report.blocks import Block, Facts, Figures, Heading, Note, Section, Table
from cellctl.report.odd import at, mapping, number, points, rows, text
from cellctl.report.phrases import figure
from cellctl.report.recorded import Recorded
from cellctl.report.svg import Scale, Svg, draw_axes, limits

TITLE = "What error to expect, and why"
WIDTH, HEIGHT = 420.0, 280.0
FAINTEST, STRONGEST = 0.06, 0.9
BAR, NAMES = 22.0, 110.0
LEAST = 0.001
"""Millimetres that are worth a figure."""
CURVES = (("predicted_mm", "train", "predicted"), ("held_out_mm", "held", "held out"))
LEGEND = (
    ("dot train", "predicted"),
    ("dot held", "measured on circles held out, whose own scatter adds to it"),
)


def section(recorded: Recorded) -> Section:
    """Map, budget, advice, curve: those that the run came to."""
    part = mapping(recorded.data, "accuracy")
    if not part:
        missing = "No error can be predicted: the run did not come to a joint adjustment."
        return Section("accuracy", TITLE, "", [Note(missing, "missing")])
    blocks: list[Block] = [*_map(recorded, part), *_budget(part), *_next(part), *_curve(part)]
    lead = (
        "Predicted from the noise of everything that was measured, propagated through the joint "
        "adjustment: one standard deviation (root mean square distance) of where light lands "
        "against where the pen stands."
    )
    return Section("accuracy", TITLE, lead, blocks)


def _map(recorded: Recorded, part: dict[str, Any]) -> list[Block]:
    facts = [
        (words, f"{figure(value)} mm")
        for words, value in (
            ("predicted, over the area", number(part.get("predicted_mm"))),
            ("best place", _extreme(part, min)),
            ("worst place", _extreme(part, max)),
            ("measured on held-out circles", number(at(recorded.part("evaluate"), "held_out_mm"))),
        )
        if value is not None
    ]
    if part.get("note"):
        facts.append(("remark", text(part["note"])))
    places = points(at(part, "map", "places"), 3)
    if len(places) < 4:
        return [Facts(facts)] if facts else []
    words = "predicted error over the table, mm; the darker, the larger"
    return [Figures([(heat_map(places), words)], beside=facts)]


def _extreme(part: dict[str, Any], which: Any) -> float | None:
    places = points(at(part, "map", "places"), 3)
    return float(which(places[:, 2])) if len(places) else None


def heat_map(places: Array) -> Markup:
    """Of (n, 3): x and y in metres, on a grid, and a figure in mm."""
    low, high = places[:, :2].min(axis=0), places[:, :2].max(axis=0)
    step = np.array([_step(places[:, i]) for i in range(2)])
    low, high = low - step / 2, high + step / 2
    scale = min((WIDTH - 76) / (high[0] - low[0]), 420.0 / (high[1] - low[1]))
    right, bottom = 60 + scale * (high[0] - low[0]), 14 + scale * (high[1] - low[1])
    svg = Svg(WIDTH, bottom + 44, "predicted error over the table")
    x, y = Scale(low[0], high[0], 60, right), Scale(low[1], high[1], bottom, 14)
    least, most = places[:, 2].min(), places[:, 2].max()
    for px, py, value in places.tolist():
        share = (value - least) / (most - least) if most > least else 0.5
        corners = ((x(px + s * step[0] / 2), y(py + s * step[1] / 2)) for s in (-1, 1))
        (x0, y0), (x1, y1) = corners
        svg.add(
            "rect",
            tip=f"x {px:.3f} m, y {py:.3f} m: {figure(value)} mm",
            cls="heat",
            x=x0,
            y=min(y0, y1),
            width=x1 - x0,
            height=abs(y1 - y0),
            fill_opacity=FAINTEST + (STRONGEST - FAINTEST) * share,
        )
    draw_axes(svg, x, y, ("x, m", "y, m"), (4, 5))
    return svg.markup()


def _step(values: Array) -> float:
    distinct = np.unique(np.round(values, 6))
    return float(np.diff(distinct).min()) if len(distinct) > 1 else 0.01


def _budget(part: dict[str, Any]) -> list[Block]:
    shares = [
        (text(row.get("source")), value)
        for row in rows(part, "budget")
        if (value := number(row.get("rms_mm"))) is not None and value >= 0
    ]
    if not shares:
        return []
    shares.sort(key=lambda share: -share[1])
    why = (
        f"Most of the error comes from: {shares[0][0]}. The squares of these add up to the square "
        "of the whole."
    )
    return [
        Heading("Where an inaccuracy slips in"),
        Note(why),
        Figures([(_bars(shares), "contribution of each source to the error on the table, mm")]),
    ]


def _bars(shares: list[tuple[str, float]]) -> Markup:
    svg = Svg(WIDTH, BAR * len(shares) + 8, "error budget")
    largest = shares[0][1] or 1.0
    for i, (name, value) in enumerate(shares):
        top, length = BAR * i + 4, (WIDTH - NAMES - 60) * value / largest
        svg.text((NAMES - 8, top + 13), name, "label", "end")
        svg.box((NAMES, top + 2), (NAMES + max(length, 1.0), top + BAR - 5), "bar train", rx=2)
        svg.text((NAMES + length + 6, top + 13), _told(value), "tick")
    return svg.markup()


def _told(value: float) -> str:
    return figure(value) if value >= LEAST else f"under {LEAST}"


def _next(part: dict[str, Any]) -> list[Block]:
    body = [
        [text(row.get("do")), figure(row.get("predicted_mm"))]
        for row in rows(part, "next")
        if row.get("do")
    ]
    if not body:
        return []
    columns = [("what could be done next", False), ("predicted error then, mm", True)]
    caption = "The first gains most. Steps that hardly lower the error are not worth their time."
    return [Heading("What to do next"), Table(columns, body, caption, strong=[0])]


def _curve(part: dict[str, Any]) -> list[Block]:
    steps = [row for row in rows(part, "curve") if (number(row.get("circles")) or 0) > 0]
    lines = {
        cls: [
            (float(row["circles"]), value)
            for row in steps
            if (value := number(row.get(field))) is not None and value > 0
        ]
        for field, cls, _ in CURVES
    }
    if max(map(len, lines.values()), default=0) < 2:
        return []
    words = "error against the number of circles that the fit may use"
    told = f" {text(part['enough'])}" if part.get("enough") else ""
    return [
        Heading("How much data is needed"),
        *([Note(told.strip())] if told else []),
        Figures([(_lines(lines), words)], legend=LEGEND),
    ]


def _lines(lines: dict[str, list[tuple[float, float]]]) -> Markup:
    every = np.array([place for line in lines.values() for place in line])
    svg = Svg(WIDTH, HEIGHT, "error against the number of circles")
    x = Scale(*limits(every[:, 0].tolist(), margin=0.03), 60, WIDTH - 16)
    low, high = float(every[:, 1].min()), float(every[:, 1].max())
    y = Scale(low / 1.2, high * 1.2, HEIGHT - 44, 14, log=True)
    draw_axes(svg, x, y, ("circles", "error, mm"))
    for cls, line in lines.items():
        places = [(x(n), y(value)) for n, value in line]
        for a, b in itertools.pairwise(places):
            svg.line(a, b, f"curve {cls}")
        for place, (n, value) in zip(places, line, strict=True):
            svg.dot(place, 3.5, f"dot {cls}", f"{n:.0f} circles: {figure(value)} mm")
    return svg.markup()
