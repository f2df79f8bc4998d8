"""The drawn half: the touched table, the candidates of the refinement and the circles held out."""

from __future__ import annotations

from typing import Any

import numpy as np
from markupsafe import Markup

from cellctl.report.blocks import Block, Facts, Figures, Heading, Note, Section, Table
from cellctl.report.errors_of import evaluated_errors
from cellctl.report.odd import at, mapping, number, numbers, rows, text, texts
from cellctl.report.phrases import figure, interval, scaled
from cellctl.report.recorded import Recorded
from cellctl.report.residuals import scatter
from cellctl.report.svg import Scale, Svg, draw_axes, limits

WIDTH = 420.0
COLUMNS = (("training", "training"), ("loo", "one left out"), ("row", "a row left out"))
ALLOWED = {True: "yes", False: "no"}


def section(recorded: Recorded) -> Section:
    """Table, refinement, evaluation: those that the run came to."""
    blocks = [*_touched(recorded), *_refined(recorded), *_evaluated(recorded)]
    if not blocks:
        blocks = [Note("The table was not touched and nothing was drawn in this run.", "missing")]
    return Section("refinement", "Table, refinement and proof", "", blocks)


def _opening(part: dict[str, Any], title: str) -> list[Block]:
    reasons = [Note(reason, "bad") for reason in texts(part.get("reasons"))]
    return [Heading(title, text(part.get("verdict"))), *reasons]


# -- measure-table


def _touched(recorded: Recorded) -> list[Block]:
    part = recorded.part("measure-table")
    if not part:
        return []
    touches = rows(part, "touches")
    normal, point = numbers(at(part, "plane", "normal"), 3), numbers(at(part, "plane", "point"), 3)
    facts = [("points touched", str(len(touches)))] if touches else []
    if point is not None:
        x, y, z = (figure(value) for value in (point[0], point[1], point[2] * 1e3))
        facts.append(("height", f"{z} mm at x {x} m, y {y} m"))
    if normal is not None:
        tilt = np.degrees(np.arctan2(np.hypot(normal[0], normal[1]), abs(normal[2])))
        facts.append(("tilt", f"{figure(float(tilt))}\N{DEGREE SIGN} against the robot's base"))
    for name, words in (("uncertainty_m", "uncertainty (1 sigma)"), ("bow_m", "bow")):
        if (value := scaled(part.get(name), 1e3)) is not None:
            facts.append((words, f"{figure(value)} mm"))
    if (value := number(part.get("rms_mm"))) is not None:
        facts.append(("RMS about the plane", f"{figure(value)} mm"))
    blocks = _opening(part, "Table")
    drawing = _touch_map(touches)
    if drawing is None:
        return [*blocks, Facts(facts)]
    words = "touched points: height above the plane, in mm"
    return [*blocks, Figures([(drawing, words)], beside=facts)]


def _touch_map(touches: list[dict[str, Any]]) -> Markup | None:
    found = [numbers([t.get(n) for n in ("x", "y", "residual_mm")], 3) for t in touches]
    places = [place for place in found if place is not None]
    if not places:
        return None
    svg = Svg(WIDTH, 280, "touched points on the table")
    x = Scale(*limits([p[0] for p in places], margin=0.15), 60, WIDTH - 16)
    y = Scale(*limits([p[1] for p in places], margin=0.15), 236, 14)
    draw_axes(svg, x, y, ("x, m", "y, m"))
    largest = max(abs(p[2]) for p in places) or 1.0
    for px, py, off in places:
        place = (x(px), y(py))
        svg.dot(place, 3 + 6 * abs(off) / largest, "mark train" if off >= 0 else "mark held")
        signed = f"+{figure(off)}" if off > 0 else figure(off)
        svg.text((place[0], place[1] - 12), signed, "tick", "middle")
    return svg.markup()


# -- refine


def _refined(recorded: Recorded) -> list[Block]:
    part = recorded.part("refine")
    if not part:
        return []
    blocks = _opening(part, "Refinement")
    if part.get("chosen") or part.get("why"):
        blocks.append(Note(f"Chosen: {text(part.get('chosen'))} ({text(part.get('why'))})."))
    if candidates := mapping(part, "candidates"):
        blocks.append(_candidates(candidates, text(part.get("chosen"))))
    facts = []
    if (off := numbers(part.get("tcp_off_mm"), 2)) is not None:
        facts.append(
            ("pen tip against its stated place", f"x {figure(off[0])}, y {figure(off[1])} mm")
        )
    if (value := number(part.get("mark_sigma_mm"))) is not None:
        facts.append(("scatter of single marks", f"{figure(value)} mm"))
    return [*blocks, Facts(facts)] if facts else blocks


def _candidates(candidates: dict[str, Any], chosen: str) -> Table:
    """In millimetres; in pixels when that is all there is."""
    known = {
        unit
        for unit in ("mm", "px")
        for name, _ in COLUMNS
        for value in candidates.values()
        if number(at(value, f"{name}_{unit}")) is not None
    }
    unit = "px" if known == {"px"} else "mm"
    columns = [("candidate", False), *((f"{words}, {unit}", True) for _, words in COLUMNS)]
    columns += [("condition", True), ("allowed", False), ("remark", False)]
    body = [
        [
            text(name),
            *(figure(at(value, f"{field}_{unit}")) for field, _ in COLUMNS),
            figure(at(value, "condition")),
            _allowed(at(value, "allowed")),
            text(at(value, "note")),
        ]
        for name, value in candidates.items()
    ]
    strong = [i for i, row in enumerate(body) if row[0] == chosen]
    return Table(columns, body, "The chosen one is set off.", strong=strong)


def _allowed(value: Any) -> str:
    return ALLOWED[value] if isinstance(value, bool) else ""


# -- evaluate


def _evaluated(recorded: Recorded) -> list[Block]:
    part = recorded.part("evaluate")
    if not part:
        return []
    blocks = _opening(part, "Proof")
    if part.get("meaning"):
        blocks.append(Note(f"What the figure means: {text(part['meaning'])}."))
    facts = [
        (f"held-out error, {unit}", f"{figure(value)} {unit}")
        for unit in ("mm", "px")
        if (value := number(part.get(f"held_out_{unit}"))) is not None
    ]
    if sure := interval(part.get("held_out_ci_mm")):
        facts.append(("95 % interval", f"{sure} mm"))
    errors = evaluated_errors(recorded)
    if not len(errors):
        return [*blocks, Facts(facts)]
    words = f"{len(errors)} circles that no fit has seen: light against drawn centre"
    return [*blocks, Figures([(scatter(errors, "mm", up=True), words)], beside=facts)]
