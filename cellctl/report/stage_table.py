"""The paper's Table II: what each step of the calibration is worth, ours beside theirs."""

from __future__ import annotations

from typing import Any

from markupsafe import Markup

from cellctl.report.blocks import Block, Figures, Note, Section, Table
from cellctl.report.odd import mapping, number, rows, text
from cellctl.report.phrases import figure
from cellctl.report.recorded import Recorded
from cellctl.report.svg import Scale, Svg, draw_axes

KINDS = (
    ("training", "training", "ring-train", "training: circles that the fit has seen"),
    ("held_out", "held out", "held", "held out: circles that no fit has seen"),
    ("true", "true", "truth", "true: known only in simulation"),
    ("paper", "paper", "paper", "the paper's figure, on its own cell"),
)
WIDTH, ROW_HEIGHT, LEFT = 720.0, 36.0, 130.0


def section(recorded: Recorded) -> Section:
    """The table, and the same on a scale."""
    found = table_rows(recorded)
    lead = (
        "Each row adds one step of the calibration and is solved again from the same recording. "
        "Errors are root mean squares of the distance between where light lands and where it "
        "should; training figures flatter, held-out figures do not."
    )
    if not found:
        missing = Note("No stage table: the run did not get as far as comparing stages.", "missing")
        return Section("stages", "What each step is worth", "", [missing])
    shown = [kind for kind in KINDS if any(_value(row, kind[0], u) for row in found for u in UNITS)]
    blocks: list[Block] = [_table(found, shown)]
    if drawing := _scale(found, shown):
        legend = [(cls, words) for _, _, cls, words in shown]
        caption = "The millimetres of the table on a logarithmic scale."
        blocks.append(Figures([(drawing, caption)], wide=True, legend=legend))
    return Section("stages", "What each step is worth", lead, blocks)


UNITS = ("px", "mm")


def table_rows(recorded: Recorded) -> list[dict[str, Any]]:
    """The rows of the result, or those of a run that drew nothing; the truth put beside them."""
    found = rows(recorded.data, "table") or [
        {**stage, "row": stage.get("name")} for stage in rows(recorded.data, "stages")
    ]
    truth = mapping(recorded.truth, "rows")
    return [{**row, **mapping(truth, text(row.get("row")))} for row in found]


def _value(row: dict[str, Any], kind: str, unit: str) -> bool:
    return number(row.get(f"{kind}_{unit}")) is not None


def _table(found: list[dict[str, Any]], shown: list[Any]) -> Table:
    columns = [("stage", False)]
    groups = [("", 1)]
    fields: list[str] = []
    for unit, name in (("px", "projector pixels"), ("mm", "millimetres")):
        here = [k for k in shown if any(_value(row, k[0], unit) for row in found)]
        if here:
            groups.append((name, len(here)))
        columns += [(heading, True) for _, heading, _, _ in here]
        fields += [f"{kind}_{unit}" for kind, _, _, _ in here]
    body = [[text(row.get("row")), *(figure(row.get(name)) for name in fields)] for row in found]
    note = "true: known only in simulation. " if any(k[0] == "true" for k in shown) else ""
    if any(k[0] == "paper" for k in shown):
        note += "paper: as published, on another cell and without held-out circles."
    return Table(columns, body, note, groups, strong=[len(body) - 1])


def _scale(found: list[dict[str, Any]], shown: list[Any]) -> Markup | None:
    """A dot a figure, rows downwards; None when there are no millimetres."""
    values = [
        value
        for row in found
        for kind, _, _, _ in shown
        if (value := number(row.get(f"{kind}_mm"))) and value > 0
    ]
    if not values:
        return None
    bottom = 14 + ROW_HEIGHT * len(found)
    svg = Svg(WIDTH, bottom + 44, "errors of each stage in millimetres")
    low, high = min(values) / 1.3, max(values) * 1.3
    x = Scale(low, high, LEFT, WIDTH - 20, log=True)
    draw_axes(svg, x, Scale(0, 1, bottom, 8), ("error, mm", ""))
    for i, row in enumerate(found):
        _scale_row(svg, x, 8 + ROW_HEIGHT * (i + 0.5), row, shown)
    return svg.markup()


def _scale_row(svg: Svg, x: Scale, y: float, row: dict[str, Any], shown: list[Any]) -> None:
    svg.text((LEFT - 14, y + 4), text(row.get("row"))[:24], "label", "end")
    places = []
    for kind, name, cls, _ in shown:
        value = number(row.get(f"{kind}_mm"))
        if value and value > 0:
            places.append((x(value), cls, f"{name}: {figure(value)} mm", kind != "paper"))
    ours = [place for place, _, _, own in places if own]
    if len(ours) > 1:
        svg.line((min(ours), y), (max(ours), y), "link")
    for place, cls, tip, _ in places:
        if cls in ("truth", "paper"):
            svg.polygon(_diamond(place, y), f"mark {cls}", tip)
        else:
            svg.dot((place, y), 6, f"mark {cls}", tip)


def _diamond(x: float, y: float) -> list[tuple[float, float]]:
    return [(x, y - 7), (x + 7, y), (x, y + 7), (x - 7, y)]
