"""The table from above: where circles were drawn, and by magnified arrows where light meant for
them would land, after each stage. The paper's Fig. 5."""

from __future__ import annotations

import math
from dataclasses import dataclass

from markupsafe import Markup

from cellctl.report.blocks import Figures, Note, Section
from cellctl.report.odd import at, number, numbers, rows, text
from cellctl.report.phrases import figure
from cellctl.report.recorded import Recorded
from cellctl.report.svg import Point, Scale, Svg

WIDTH = 420.0
MARGIN = 2.0
BELOW, ABOVE = 56.0, 44.0
REACH, FURTHEST = 0.10, 0.16
"""How long the arrow of a typical (root mean square) error is drawn at most, and the longest of
all, of the map's longer side."""
MAGNIFICATIONS = [m * 10**e for e in range(5) for m in (1, 2, 5)]
LEGEND = (
    ("dot train", "drawn circle, used by the fit"),
    ("dot held", "drawn circle, held out"),
    ("arrow-key", "from the drawn centre to where the light for it lands, magnified"),
    ("sheet-key", "sheet of paper"),
    ("area-key", "drawn area"),
)


@dataclass(frozen=True)
class Arrow:
    """`x`, `y` in the world, metres; `dx`, `dy` the error in millimetres."""

    key: str
    x: float
    y: float
    dx: float
    dy: float
    held_out: bool

    @property
    def length(self) -> float:
        return math.hypot(self.dx, self.dy)


def section(recorded: Recorded) -> Section:
    """A map for each stage."""
    title = "Where light lands"
    stages = arrows_of(recorded)
    if not stages:
        missing = "No map of errors: no circles were drawn and found, or the run ended before that."
        return Section("table", title, "", [Note(missing, "missing")])
    frame = _frame(recorded, [arrow for arrows in stages.values() for arrow in arrows])
    figures = [(_map(recorded, frame, name, arrows), "") for name, arrows in stages.items()]
    lead = (
        "The table from above, in the robot's frame. An arrow leads from the centre of a drawn "
        "circle to where the light that is sent for it lands. Each map has its own magnification, "
        "so that its typical arrow can be seen; the arrow below each map is the measure."
    )
    return Section("table", title, lead, [Figures(figures, legend=LEGEND)])


def arrows_of(recorded: Recorded) -> dict[str, list[Arrow]]:
    """By stage; those that can be drawn."""
    stages = recorded.data.get("arrows")
    if not isinstance(stages, dict):
        return {}
    found = {
        text(name): [a for row in rows(listed) if (a := _arrow(row))]
        for name, listed in stages.items()
    }
    return {name: arrows for name, arrows in found.items() if arrows}


def _arrow(row: dict[str, object]) -> Arrow | None:
    known = numbers([row.get(name) for name in ("x", "y", "dx_mm", "dy_mm")], 4)
    if known is None:
        return None
    x, y, dx, dy = known
    return Arrow(text(row.get("key")), x, y, dx, dy, row.get("held_out") is True)


@dataclass(frozen=True)
class _Frame:
    """World rectangle (metres) that a map shows, and its height in the drawing."""

    low: Point
    high: Point
    height: float

    @property
    def x(self) -> Scale:
        return Scale(self.low[0], self.high[0], MARGIN, WIDTH - MARGIN)

    @property
    def y(self) -> Scale:
        return Scale(self.low[1], self.high[1], ABOVE + self.height, ABOVE)

    @property
    def per_metre(self) -> float:
        return (WIDTH - 2 * MARGIN) / (self.high[0] - self.low[0])

    @property
    def side(self) -> float:
        return max(WIDTH - 2 * MARGIN, self.height)


def _frame(recorded: Recorded, arrows: list[Arrow]) -> _Frame:
    corners = [(a.x, a.y) for a in arrows]
    low = (min(c[0] for c in corners), min(c[1] for c in corners))
    high = (max(c[0] for c in corners), max(c[1] for c in corners))
    span = max(high[0] - low[0], high[1] - low[1], 0.01)
    inside = [c for box in _sheets(recorded) for c in box if _near(c, low, high, 0.25 * span)]
    low = (min([low[0], *(c[0] for c in inside)]), min([low[1], *(c[1] for c in inside)]))
    high = (max([high[0], *(c[0] for c in inside)]), max([high[1], *(c[1] for c in inside)]))
    pad = 0.06 * span
    low, high = (low[0] - pad, low[1] - pad), (high[0] + pad, high[1] + pad)
    ratio = (high[1] - low[1]) / (high[0] - low[0])
    return _Frame(low, high, min((WIDTH - 2 * MARGIN) * ratio, 4 * WIDTH))


def _near(corner: Point, low: Point, high: Point, margin: float) -> bool:
    return all(low[i] - margin <= corner[i] <= high[i] + margin for i in (0, 1))


def _sheets(recorded: Recorded) -> list[tuple[Point, Point]]:
    """Corners of the sheets that the cell declares, metres."""
    found = []
    for sheet in rows(recorded.config, "sheets"):
        low, high = numbers(_list(sheet, "min_m"), 2), numbers(_list(sheet, "max_m"), 2)
        if low is not None and high is not None:
            found.append(((low[0], low[1]), (high[0], high[1])))
    return found


def _list(sheet: dict[str, object], name: str) -> object:
    return at(sheet, name)


def rms_mm(arrows: list[Arrow]) -> float | None:
    """Root mean square length."""
    if not arrows:
        return None
    return number(math.sqrt(sum(a.length**2 for a in arrows) / len(arrows)))


def magnification(arrows: list[Arrow], per_metre: float, side: float) -> int:
    """A round number by which arrows are lengthened; 1 when there is nothing to see."""
    typical, longest = rms_mm(arrows) or 0.0, max(arrow.length for arrow in arrows)
    if not typical > 0:
        return 1
    wanted = min(REACH / typical, FURTHEST / longest) * side / (1e-3 * per_metre)
    return max([m for m in MAGNIFICATIONS if m <= wanted] or [1])


def _map(recorded: Recorded, frame: _Frame, name: str, arrows: list[Arrow]) -> Markup:
    svg = Svg(WIDTH, ABOVE + frame.height + BELOW, f"errors on the table: {name}")
    typical = rms_mm(arrows) or 0.0
    enlarged = magnification(arrows, frame.per_metre, frame.side)
    svg.text((MARGIN, 18), name, "heading")
    svg.text((MARGIN, 35), _told(arrows), "label")
    svg.text((WIDTH - MARGIN, 18), f"arrows \N{MULTIPLICATION SIGN}{enlarged}", "strong", "end")
    svg.box((frame.x.start, frame.y.start), (frame.x.end, frame.y.end), "frame", rx=3)
    for low, high in _sheets(recorded):
        svg.box(_place(frame, *_inside(frame, low)), _place(frame, *_inside(frame, high)), "sheet")
    _outline(svg, frame, arrows)
    for arrow in sorted(arrows, key=lambda a: a.held_out):
        _draw(svg, frame, arrow, enlarged)
    _scales(svg, frame, typical, enlarged)
    return svg.markup()


def _inside(frame: _Frame, corner: Point) -> Point:
    x = min(max(corner[0], frame.low[0]), frame.high[0])
    return x, min(max(corner[1], frame.low[1]), frame.high[1])


def _place(frame: _Frame, x: float, y: float) -> Point:
    return frame.x(x), frame.y(y)


def _told(arrows: list[Arrow]) -> str:
    parts = []
    for words, held_out in (("training", False), ("held out", True)):
        if (value := rms_mm([a for a in arrows if a.held_out is held_out])) is not None:
            parts.append(f"{words} {figure(value)} mm")
    return "rms " + ", ".join(parts)


def _outline(svg: Svg, frame: _Frame, arrows: list[Arrow]) -> None:
    low = _place(frame, min(a.x for a in arrows), min(a.y for a in arrows))
    high = _place(frame, max(a.x for a in arrows), max(a.y for a in arrows))
    svg.box(low, high, "area")


def _draw(svg: Svg, frame: _Frame, arrow: Arrow, enlarged: int) -> None:
    cls = "held" if arrow.held_out else "train"
    place = _place(frame, arrow.x, arrow.y)
    far = 1e-3 * enlarged * frame.per_metre
    tip = (place[0] + arrow.dx * far, place[1] - arrow.dy * far)
    kind = "held out" if arrow.held_out else "training"
    told = f"{arrow.key}: {figure(arrow.length)} mm ({kind})"
    svg.arrow(place, tip, f"arrow {cls}", told)
    svg.dot(place, 2.6, f"dot {cls}", told)


def _scales(svg: Svg, frame: _Frame, typical: float, enlarged: int) -> None:
    """A bar for the map and an arrow for the errors."""
    y = ABOVE + frame.height + 20
    bar = _round_below(0.3 * (frame.high[0] - frame.low[0]) * 1e3)
    length = bar * 1e-3 * frame.per_metre
    svg.line((MARGIN, y), (MARGIN + length, y), "scale")
    for x in (MARGIN, MARGIN + length):
        svg.line((x, y - 4), (x, y + 4), "scale")
    svg.text((MARGIN, y + 18), f"{bar:g} mm on the table", "label")
    measure = _round_below(max(typical, 1e-3) * 1.5)
    shown = measure * 1e-3 * enlarged * frame.per_metre
    start = WIDTH - MARGIN - max(shown, 1.0)
    svg.arrow((start, y), (start + shown, y), "scale")
    svg.text((WIDTH - MARGIN, y + 18), f"error of {measure:g} mm", "label", "end")


def _round_below(value: float) -> float:
    """The largest of 1, 2, 5 and their tens that is no more than `value`."""
    power = 10.0 ** math.floor(math.log10(value))
    return max(m * power for m in (1, 2, 5) if m * power <= value * (1 + 1e-9))
