"""What each step leaves unexplained: bars by view, and where the single points miss."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from cellctl.calib.views import rms
from cellctl.geometry import Array
from cellctl.report import errors_of
from cellctl.report.blocks import Block, Facts, Figures, Heading, Note, Section, Table
from cellctl.report.odd import at, mapping, number, numbers, text, texts
from cellctl.report.phrases import MINUS, figure
from cellctl.report.recorded import Recorded
from cellctl.report.svg import Scale, Svg, draw_axes, limits
from cellctl.report.views import size_of

WIDTH, HEIGHT = 420.0, 260.0
MOST_POINTS, FEW_POINTS = 1500, 150
MOST_BARS = 60
BARS = (("bar train", "in the fit"), ("bar held", "held out: predicted by a fit without this view"))


@dataclass(frozen=True)
class Step:
    """A part of the run whose errors are shown. `against` says what the points are errors of."""

    part: str
    title: str
    unit: str
    against: str
    errors: Callable[[Recorded], Array]
    bars: bool = False


STEPS = (
    Step(
        "intrinsic",
        "Camera",
        "camera px",
        "board corners against the camera, each view in its best pose",
        errors_of.intrinsic_errors,
        bars=True,
    ),
    Step(
        "hand-eye",
        "Hand-eye",
        "camera px",
        "marker corners against where the robot says that the board is",
        errors_of.hand_eye_errors,
        bars=True,
    ),
    Step(
        "projector",
        "Projector",
        "projector px",
        "projected markers against the camera-to-projector map",
        errors_of.projector_errors,
    ),
)
FIGURES = (
    ("rms_px", "RMS in the fit", "px", 1.0),
    ("held_out_px", "RMS held out", "px", 1.0),
    ("held_out_used_px", "held out, without what was rejected", "px", 1.0),
)


def section(recorded: Recorded) -> Section:
    """A part for each step that came to a result."""
    blocks = [block for step in STEPS for block in _step(recorded, step)]
    lead = (
        "A held-out figure counts only what the fit has not seen. Points that scatter about the "
        "middle without a direction are noise; a pattern is something that the model lacks."
    )
    if not blocks:
        blocks = [Note("No step came to a result that could leave residuals.", "missing")]
        lead = ""
    return Section("residuals", "What is left unexplained", lead, blocks)


def _step(recorded: Recorded, step: Step) -> list[Block]:
    part = recorded.part(step.part)
    if not part:
        return []
    blocks: list[Block] = [Heading(step.title, text(part.get("verdict")))]
    blocks += [Note(reason, "bad") for reason in texts(part.get("reasons"))]
    figures = []
    if step.bars and (bars := errors_of.per_view(recorded, step.part)):
        figures.append((_bars(bars, step), _cut(len(bars))))
    errors = step.errors(recorded)
    if len(errors):
        figures.append((scatter(errors, step.unit), f"{step.against}: {len(errors)} points"))
    if step.part == "projector" and (field := _field(recorded)) is not None:
        figures.append(field)
    if figures:
        blocks.append(Figures(figures, legend=BARS if step.bars else ()))
    facts = [*_facts(part), *_more(part)]
    if facts:
        blocks.append(Facts(facts))
    if candidates := _candidates(part):
        blocks.append(candidates)
    return blocks


def _cut(count: int) -> str:
    shown = f"; the first {MOST_BARS} of {count}" if count > MOST_BARS else ""
    return f"error of each view, RMS{shown}"


def _facts(part: dict[str, Any]) -> list[tuple[str, str]]:
    used = errors_of.used_count(part)
    facts = [("used", str(used))] if used else []
    for name, words, unit, factor in FIGURES:
        if (value := number(part.get(name))) is not None:
            facts.append((words, f"{figure(value * factor)} {unit}"))
    return facts


def _more(part: dict[str, Any]) -> list[tuple[str, str]]:
    """The camera's parameters with their uncertainty; what hand-eye says in words of a workshop."""
    facts = []
    sigma = mapping(part, "camera_sigma")
    matrix, lens = at(part, "camera", "K"), at(part, "camera", "distortion", "coefficients")
    if isinstance(matrix, list) and sigma:
        facts += _camera(matrix, lens, sigma)
    summary = mapping(part, "summary")
    units = {"mm": "mm", "deg": "\N{DEGREE SIGN}"}
    for name, value in summary.items():
        unit = units.get(name.rpartition("_")[2], "")
        words = name.removesuffix("_mm").removesuffix("_deg").replace("_", " ")
        facts.append((text(words), f"{figure(value)} {unit}".strip()))
    if part.get("why"):
        facts.append(("method", f"{text(part.get('method'))}: {text(part['why'])}"))
    return facts


def _camera(matrix: list[Any], lens: Any, sigma: dict[str, Any]) -> list[tuple[str, str]]:
    cells = [numbers(row, 3) for row in matrix[:2]]
    if len(cells) < 2 or cells[0] is None or cells[1] is None:
        return []
    values = [cells[0][0], cells[1][1], cells[0][2], cells[1][2], *(numbers(lens, 5) or [])]
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    return [
        (name, f"{_measured(value, number(sigma.get(name)))}{' px' * (i < 4)}")
        for i, (name, value) in enumerate(zip(names, values, strict=False))
    ]


def _measured(value: float, sigma: float | None) -> str:
    """With its standard deviation, both to the second digit of the latter."""
    if sigma is None or not 1e-12 < sigma < 1e6:
        return f"{value:.6g}".replace("-", MINUS)
    digits = max(0, 1 - math.floor(math.log10(sigma)))
    return f"{value:.{digits}f} \N{PLUS-MINUS SIGN} {sigma:.{digits}f}".replace("-", MINUS)


def _candidates(part: dict[str, Any]) -> Table | None:
    candidates = mapping(part, "candidates")
    if not candidates:
        return None
    body = [
        [text(name), figure(at(c, "rms_px")), figure(at(c, "held_out_px"))]
        for name, c in candidates.items()
    ]
    strong = [i for i, row in enumerate(body) if row[0] == text(part.get("method"))]
    columns = [("method", False), ("in the fit, px", True), ("held out, px", True)]
    return Table(
        columns, body, "The methods that were compared; the chosen one is set off.", strong=strong
    )


def _bars(found: list[tuple[str, float | None, float | None]], step: Step) -> Markup:
    found = found[:MOST_BARS]
    svg = Svg(WIDTH, HEIGHT, f"{step.title}: error of each view")
    values = [value for _, *pair in found for value in pair if value is not None]
    x = Scale(0, len(found), 64, WIDTH - 10)
    y = Scale(*limits(values, zero=True, margin=0.1), HEIGHT - 34, 12)
    draw_axes(svg, x, y, ("", step.unit))
    width = (x(1) - x(0)) * 0.38
    for i, (key, training, held_out) in enumerate(found):
        for j, (value, words) in enumerate(((training, "in the fit"), (held_out, "held out"))):
            if value is not None:
                left = x(i + 0.12) + j * width
                svg.box(
                    (left, y(0)),
                    (left + width, y(value)),
                    BARS[j][0],
                    f"{key}: {figure(value)} px {words}",
                )
    svg.text(
        ((x.start + x.end) / 2, HEIGHT - 10),
        f"views, {found[0][0]} to {found[-1][0]}",
        "axis",
        "middle",
    )
    return svg.markup()


def _field(recorded: Recorded) -> tuple[Markup, str] | None:
    """Where in the projector's picture the errors lie."""
    places, errors = errors_of.projector_field(recorded)
    size = size_of(at(recorded.config, "projector", "size_px"))
    if size is None or not len(errors):
        return None
    scale = WIDTH / size[0]
    svg = Svg(WIDTH, size[1] * scale, "errors over the projector's picture")
    svg.box((0.5, 0.5), (WIDTH - 0.5, size[1] * scale - 0.5), "frame", rx=3)
    wanted = 12 / (scale * max(rms(errors), 1e-9))
    enlarged = max([m * 10**e for e in range(5) for m in (1, 2, 5) if m * 10**e <= wanted] or [1])
    for (x, y), (dx, dy) in zip(places * scale, errors * (scale * enlarged), strict=True):
        a = (float(x), float(y))
        svg.arrow(a, (a[0] + float(dx), a[1] + float(dy)), "arrow train", head=3.5)
    return (
        svg.markup(),
        f"the same over the projector's picture, arrows \N{MULTIPLICATION SIGN}{enlarged}",
    )


def scatter(errors: Array, unit: str, *, up: bool = False) -> Markup:
    """Errors (n, 2) about zero, with a circle at their root mean square. y runs downwards as in
    a picture, or `up` as on the table."""
    top, half = 26.0, 120.0
    svg = Svg(WIDTH, top + 2 * half + 44, f"errors of single points in {unit}")
    spread = rms(errors)
    reach = max(float(np.quantile(np.abs(errors), 0.995)) * 1.15, spread * 1.3, 1e-6)
    middle = (WIDTH + 40) / 2
    x = Scale(-reach, reach, middle - half, middle + half)
    low = -reach if up else reach
    y = Scale(low, -low, top + 2 * half, top)
    draw_axes(svg, x, y, (f"x, {unit}", f"y, {unit}"))
    shown = errors[:: max(1, len(errors) // MOST_POINTS)]
    inside = shown[(np.abs(shown) <= reach).all(axis=1)]
    places = ((x(float(dx)), y(float(dy))) for dx, dy in inside)
    svg.cloud(places, "points" if len(inside) > FEW_POINTS else "points few")
    svg.dot((x(0.0), y(0.0)), x(spread) - x(0.0), "rms")
    svg.text((middle, 15), f"RMS {figure(spread)} {unit}", "strong", "middle")
    return svg.markup()
