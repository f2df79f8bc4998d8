"""With what the run was made, and how it went: enough to do it again, or to ask whoever did."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from markupsafe import Markup

from cellctl.report.blocks import Block, Facts, Figures, Folded, Heading, Note, Section, Table
from cellctl.report.odd import at, mapping, pretty, text
from cellctl.report.phrases import date, duration, moment, plural
from cellctl.report.recorded import Recorded
from cellctl.report.svg import Scale, Svg, draw_axes
from cellctl.store.history import ENDED

WIDTH, LEFT, ROW_HEIGHT = 860.0, 190.0, 24.0
MOST_BARS = 40
STOPS = ENDED | {"interrupted"}
HAPPENED = {
    "started": "started",
    "resumed": "resumed",
    "question": "asked the operator",
    "answer": "was answered",
    "withdrawn": "took the question back",
    "result": "came to a result",
    "done": "done",
    "failed": "failed",
    "cancelled": "cancelled",
    "interrupted": "interrupted",
    "abandoned": "given up",
    "acknowledged": "the fault was acknowledged",
}


def section(recorded: Recorded) -> Section:
    """Timeline, devices, versions, parameters, config, calibrations."""
    blocks: list[Block] = []
    if recorded.problems:
        blocks.append(Heading("What could not be read"))
        blocks += [Note(problem, "missing") for problem in recorded.problems]
    blocks += [*_timeline(recorded), *_made_with(recorded), *_calibrations(recorded)]
    return Section("record", "The record", "", blocks)


# -- how it went


@dataclass(frozen=True)
class Bar:
    """A step while it went on, in seconds from the start; `samples` were taken in it."""

    step: str
    start: float
    end: float
    samples: int


def bars_of(recorded: Recorded) -> list[Bar]:
    """Steps in the order in which they were begun; a step ends where the next one begins or the
    run stops."""
    timed = [(m, e) for e in recorded.entries if (m := moment(e.time)) is not None]
    if not timed:
        return []
    zero, bars = timed[0][0], list[Bar]()
    step, begun, samples = "", zero, 0
    for when, entry in timed:
        if entry.kind == "sample":
            samples += 1
        if entry.kind in ("step", "result", *STOPS):
            if step:
                bars.append(Bar(step, _since(zero, begun), _since(zero, when), samples))
            step, begun, samples = (entry.at if entry.kind == "step" else ""), when, 0
    if step:
        bars.append(Bar(step, _since(zero, begun), _since(zero, timed[-1][0]), samples))
    return bars


def _since(zero: datetime, when: datetime) -> float:
    return max((when - zero).total_seconds(), 0.0)


def _timeline(recorded: Recorded) -> list[Block]:
    events = [
        [date(e.time), HAPPENED[e.kind], _said(e.data)]
        for e in recorded.entries
        if e.kind in HAPPENED
    ]
    if not events:
        return []
    blocks: list[Block] = [Heading("How it went")]
    if bars := bars_of(recorded):
        cut = f"; the first {MOST_BARS} of {len(bars)} steps" if len(bars) > MOST_BARS else ""
        caption = f"The steps over time, and how many samples each took{cut}."
        blocks.append(Figures([(_gantt(bars[:MOST_BARS]), caption)], wide=True))
    columns = [("when", False), ("what", False), ("", False)]
    return [*blocks, Table(columns, events[-100:])]


def _said(data: dict[str, object]) -> str:
    for name in ("error", "text", "answer", "verdict"):
        if data.get(name):
            return text(data[name])
    return ""


def _gantt(bars: list[Bar]) -> Markup:
    end = max(1e-3, *(bar.end for bar in bars))
    minutes = end > 150
    per = 60.0 if minutes else 1.0
    bottom = 10 + ROW_HEIGHT * len(bars)
    svg = Svg(WIDTH, bottom + 42, "steps over time")
    x = Scale(0.0, end / per, LEFT, WIDTH - 70)
    draw_axes(svg, x, Scale(0, 1, bottom, 6), ("minutes" if minutes else "seconds", ""), (8, 5))
    for i, bar in enumerate(bars):
        y = 10 + ROW_HEIGHT * i
        told = f"{bar.step}: {duration(bar.end - bar.start)}, {plural(bar.samples, 'sample')}"
        svg.text((LEFT - 10, y + 15), bar.step[:30], "label", "end")
        right = max(x(bar.end / per), x(bar.start / per) + 2)
        svg.box((x(bar.start / per), y + 4), (right, y + 20), "bar train", told, rx=2)
        words = duration(bar.end - bar.start) + (f" ({bar.samples})" if bar.samples else "")
        svg.text((right + 6, y + 16), words, "tick")
    return svg.markup()


# -- with what


def _made_with(recorded: Recorded) -> list[Block]:
    header = recorded.header
    blocks: list[Block] = []
    if header.devices:
        names = list(dict.fromkeys(key for d in header.devices.values() for key in d))
        columns = [("device", False), *((text(name), False) for name in names)]
        body = [
            [text(device), *(text(values.get(name)) for name in names)]
            for device, values in header.devices.items()
        ]
        blocks += [Heading("Devices"), Table(columns, body)]
    if header.versions:
        blocks += [
            Heading("Versions"),
            Facts([(text(k), text(v)) for k, v in header.versions.items()]),
        ]
    blocks += [Heading("What was asked for"), Facts(_asked(recorded))]
    if header.params:
        blocks.append(Folded("Parameters", pretty(header.params)))
    if header.config:
        blocks.append(Folded("The cell's config", pretty(header.config)))
    return blocks


def _asked(recorded: Recorded) -> list[tuple[str, str]]:
    header = recorded.header
    return [
        ("by", text(header.client)),
        ("request", text(header.request_id)),
        ("speed", f"{header.speed:g} %"),
        ("asked before every motion", "yes" if header.step else "no"),
        ("config, SHA-256", text(header.config_sha256)),
        ("folder", text(str(recorded.directory))),
    ]


def _calibrations(recorded: Recorded) -> list[Block]:
    active, came = recorded.header.active_calibration, recorded.standing.calibration_id
    facts = [
        ("in use when the run started", text(active) or "none"),
        ("came of this run", text(came) or "none"),
    ]
    blocks: list[Block] = [Heading("Calibrations"), Facts(facts)]
    calibration = recorded.calibration
    pose = at(calibration, "T_world_camera")
    if pose is not None:
        blocks.append(
            Folded("T_world_camera: p_world = T_world_camera p_camera, metres", _matrix(pose))
        )
    if matrix := at(calibration, "projector", "H"):
        title = "Projector homography, from undistorted normalised camera coordinates"
        blocks.append(Folded(title, _matrix(matrix)))
    if mapping(calibration):
        blocks.append(Folded("The whole calibration", pretty(calibration)))
    return blocks


def _matrix(value: object) -> str:
    """Rows below each other."""
    if not isinstance(value, list):
        return text(value)
    return "\n".join(pretty(row, indent=None) for row in value[:20])
