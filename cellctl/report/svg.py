"""Figures as inline SVG: sharp at any size, a few kilobytes, in the page's own colours, which are
classes of its style sheet and so follow light, dark and print."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup, escape

Point = tuple[float, float]


class Svg:
    """A drawing of `width` x `height` user units, which scales to the width it is given.

    `name` is read out to those who cannot see it. Attributes are keywords: `cls` is the class,
    `font_size` becomes `font-size`. All text is escaped.
    """

    def __init__(self, width: float, height: float, name: str) -> None:
        self.width, self.height, self.name = width, height, name
        self._parts: list[str] = []

    def add(self, tag: str, content: Any = "", /, *, tip: str = "", **attributes: Any) -> None:
        """An element; `tip` is shown when the pointer rests on it."""
        named = "".join(
            f' {_name(name)}="{escape(_value(value))}"'
            for name, value in attributes.items()
            if value is not None
        )
        inner = f"<title>{escape(tip)}</title>" if tip else ""
        self._parts.append(f"<{tag}{named}>{inner}{escape(content)}</{tag}>")

    def cloud(self, points: Iterable[Sequence[float]], cls: str) -> None:
        """Many dots as one path; their size is the class's stroke width."""
        path = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in points)
        self._parts.append(f'<path class="{escape(cls)}" d="{path}"></path>')

    def line(self, a: Point, b: Point, cls: str, **more: Any) -> None:
        self.add("line", cls=cls, x1=a[0], y1=a[1], x2=b[0], y2=b[1], **more)

    def dot(self, centre: Point, radius: float, cls: str, tip: str = "") -> None:
        self.add("circle", tip=tip, cls=cls, cx=centre[0], cy=centre[1], r=radius)

    def box(self, low: Point, high: Point, cls: str, tip: str = "", rx: float = 0.0) -> None:
        """A rectangle between two corners, in any order."""
        x, y = min(low[0], high[0]), min(low[1], high[1])
        width, height = abs(high[0] - low[0]), abs(high[1] - low[1])
        self.add("rect", tip=tip, cls=cls, x=x, y=y, width=width, height=height, rx=rx or None)

    def polygon(self, points: Iterable[Sequence[float]], cls: str, tip: str = "") -> None:
        self.add("polygon", tip=tip, cls=cls, points=_path(points))

    def text(self, place: Point, content: Any, cls: str = "label", anchor: str = "start") -> None:
        self.add("text", content, cls=cls, x=place[0], y=place[1], text_anchor=anchor)

    def arrow(self, a: Point, b: Point, cls: str, tip: str = "", head: float = 5.0) -> None:
        """From a to b; a head that is no longer than the arrow."""
        self.add("line", tip=tip, cls=cls, x1=a[0], y1=a[1], x2=b[0], y2=b[1])
        dx, dy = b[0] - a[0], b[1] - a[1]
        length = math.hypot(dx, dy)
        if length < 1e-6:
            return
        head = min(head, length)
        ux, uy = dx / length, dy / length
        foot = (b[0] - head * ux, b[1] - head * uy)
        side = (-0.38 * head * uy, 0.38 * head * ux)
        corners = (
            b,
            (foot[0] + side[0], foot[1] + side[1]),
            (foot[0] - side[0], foot[1] - side[1]),
        )
        self.polygon(corners, f"{cls} head")

    def markup(self) -> Markup:
        """The drawing."""
        box = f"0 0 {_value(self.width)} {_value(self.height)}"
        opened = f'<svg viewBox="{box}" role="img" aria-label="{escape(self.name)}">'
        whole = f"{opened}{''.join(self._parts)}</svg>"
        return Markup(whole)  # noqa: S704 - every text and attribute in it is escaped


def _name(name: str) -> str:
    return "class" if name == "cls" else name.replace("_", "-")


def _value(value: Any) -> str:
    return f"{value:.2f}".rstrip("0").rstrip(".") if isinstance(value, float) else str(value)


def _path(points: Iterable[Sequence[float]]) -> str:
    return " ".join(f"{p[0]:.1f},{p[1]:.1f}" for p in points)


def ticks(low: float, high: float, wanted: int = 5) -> list[float]:
    """Round numbers within [low, high], at most about `wanted`."""
    span = high - low
    if not span > 0 or not math.isfinite(span):
        return [low]
    raw = span / max(wanted, 1)
    power = 10.0 ** math.floor(math.log10(raw))
    step = power * next(m for m in (1, 2, 2.5, 5, 10, 20) if m * power >= raw)
    first = math.ceil(low / step - 1e-9)
    found = [step * (first + i) for i in range(int(span / step + 1e-6) + 1)]
    return [tick for tick in found if tick <= high + 1e-9 * span]


def log_ticks(low: float, high: float) -> list[float]:
    """1, 2, 5 and their tens within [low, high]; the tens alone when there would be many."""
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    steps = (1, 2, 5) if last - first <= 3 else (1,)
    found = [m * 10.0**e for e in range(first, last + 1) for m in steps]
    return [tick for tick in found if low * (1 - 1e-9) <= tick <= high * (1 + 1e-9)]


def tick_label(value: float) -> str:
    """Without what rounding leaves behind."""
    value = 0.0 if abs(value) < 1e-12 else value
    return f"{value:.4g}".replace("-", "\N{MINUS SIGN}")


@dataclass(frozen=True)
class Scale:
    """Data values onto a length of the drawing; `log` when both limits are above zero."""

    low: float
    high: float
    start: float
    end: float
    log: bool = False

    def __call__(self, value: float) -> float:
        low, high = self.low, self.high
        if self.log:
            low, high, value = math.log(low), math.log(high), math.log(max(value, 1e-12))
        share = (value - low) / (high - low) if high != low else 0.5
        return self.start + (self.end - self.start) * share

    def ticks(self, wanted: int = 5) -> list[float]:
        low, high = min(self.low, self.high), max(self.low, self.high)
        return log_ticks(low, high) if self.log else ticks(low, high, wanted)


def draw_axes(
    svg: Svg, x: Scale, y: Scale, labels: tuple[str, str], wanted: Point = (5, 5)
) -> None:
    """Grid lines, figures at them, and what the axes are. An axis with no label is left out."""
    if labels[0]:
        for tick in x.ticks(int(wanted[0])):
            svg.line((x(tick), y.start), (x(tick), y.end), "grid")
            svg.text((x(tick), y.start + 16), tick_label(tick), "tick", "middle")
        svg.text(((x.start + x.end) / 2, y.start + 34), labels[0], "axis", "middle")
    if labels[1]:
        for tick in y.ticks(int(wanted[1])):
            svg.line((x.start, y(tick)), (x.end, y(tick)), "grid")
            svg.text((x.start - 6, y(tick) + 4), tick_label(tick), "tick", "end")
        across, middle = max(x.start - 46, 14.0), (y.start + y.end) / 2
        turned = f"translate({across:.1f} {middle:.1f}) rotate(-90)"
        svg.add("text", labels[1], cls="axis", text_anchor="middle", transform=turned)


def limits(values: Sequence[float], *, margin: float = 0.06, zero: bool = False) -> Point:
    """From the least to the largest with a margin; never an empty range. `zero`: from zero up."""
    low, high = (min(values), max(values)) if len(values) else (0.0, 1.0)
    if zero:
        return 0.0, (high * (1 + margin)) if high > 0 else 1.0
    span = (high - low) or abs(high) or 1.0
    return low - margin * span, high + margin * span
