"""A few of the run's pictures, made small, with what was found in them drawn over."""

from __future__ import annotations

import base64
from collections.abc import Sequence

import cv2
import numpy as np
from markupsafe import Markup

from cellctl.drivers.base import Image
from cellctl.errors import BadInput
from cellctl.geometry import Array
from cellctl.report.blocks import Block, Figures, Note, Section
from cellctl.report.odd import at, points
from cellctl.report.recorded import Recorded, good
from cellctl.report.svg import Svg
from cellctl.report.views import drawn_circles, held_out_keys, shown_markers
from cellctl.store.history import Sample
from cellctl.store.pictures import Picture

LONGEST_SIDE = 1100
QUALITY = 72
MOST_BYTES = 300_000
"""Of one picture: with six of them the page stays below 3 MB, as base64 takes a third more."""
MOST_MARKS = 400

Marks = Sequence[tuple[str, Array]]


def section(recorded: Recorded) -> Section:
    """The first good picture of each step, and the sheet at the end."""
    blocks: list[Block] = []
    figures: list[tuple[Markup, str]] = []
    for caption, picture, marks in _chosen(recorded):
        try:
            figures.append((photo(picture.load(), marks, caption), caption))
        except (BadInput, ValueError, cv2.error) as error:
            blocks.append(Note(f"{caption}: the picture cannot be shown: {error}", "missing"))
    if figures:
        blocks.insert(0, Figures(figures))
    if not blocks:
        blocks.append(Note("The run recorded no pictures.", "missing"))
    return Section("pictures", "As the camera saw it", "", blocks)


def _chosen(recorded: Recorded) -> list[tuple[str, Picture, Marks]]:
    found: list[tuple[str, Picture, Marks]] = []
    for part, words in (("intrinsic", "checkerboard"), ("hand-eye", "marker board")):
        samples = good(recorded.samples(part, "views"), None) or recorded.samples(part, "search")
        for key, sample in samples.items():
            if (picture := recorded.picture_of(sample)) is not None:
                marks = [("corner", points(at(sample.data, "pixels"), 2))]
                found.append((f"{part}: {words}, {key}", picture, marks))
                break
    found += _projected(recorded)
    found += _drawn(recorded)
    return found


def _projected(recorded: Recorded) -> list[tuple[str, Picture, Marks]]:
    centres = dict(shown_markers(recorded))
    for key, sample in recorded.samples("projector", "pictures").items():
        if (picture := recorded.picture_of(sample)) is not None:
            seen = list(centres.get(key, {}).values())
            marks = [("corner", np.array(seen).reshape(-1, 2))]
            return [(f"projector: markers on the table, {key}", picture, marks)]
    return []


def _drawn(recorded: Recorded) -> list[tuple[str, Picture, Marks]]:
    """The last picture of the sheet, with the circles that were found in it."""
    pictured = [
        (key, sample, picture)
        for samples in recorded.steps_of("draw").values()
        for key, sample in samples.items()
        if (picture := recorded.picture_of(sample)) is not None
    ]
    if not pictured:
        return []
    key, sample, picture = pictured[-1]
    circles = [c for c in drawn_circles(recorded) if c.centre is not None]
    named = {key, picture.path.name, f"images/{picture.path.name}", *sample_names(sample)}
    here = [c for c in circles if c.picture in named] or circles
    unseen = held_out_keys(recorded)
    marks = [
        (cls, np.array([c.centre for c in here if (c.key in unseen) is held]).reshape(-1, 2))
        for cls, held in (("circled train", False), ("circled held", True))
    ]
    return [(f"draw: the sheet at the end, {len(here)} circles found ({key})", picture, marks)]


def sample_names(sample: Sample) -> list[str]:
    """What else a picture of a sample may be called."""
    return [f"{sample.key}/{name}" for name in sample.images]


def photo(image: Image, marks: Marks, name: str) -> Markup:
    """A picture with marks at pixels (n, 2) of the full one."""
    height, width = image.shape[:2]
    svg = Svg(float(width), float(height), name)
    content = _jpeg(image)
    svg.add(
        "image",
        href="data:image/jpeg;base64," + base64.b64encode(content).decode(),
        width=width,
        height=height,
    )
    for cls, places in marks:
        radius = width * (0.011 if "circled" in cls else 0.0035)
        for x, y in places[:MOST_MARKS]:
            svg.dot((float(x), float(y)), radius, f"photo {cls}")
    return svg.markup()


def _jpeg(image: Image) -> bytes:
    """Small enough for the page, whatever it shows."""
    side, quality = LONGEST_SIDE, QUALITY
    while True:
        shrink = min(1.0, side / max(image.shape[:2]))
        small = cv2.resize(image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
        content = cv2.imencode(".jpg", small, (cv2.IMWRITE_JPEG_QUALITY, quality))[1].tobytes()
        if len(content) <= MOST_BYTES or side <= 200:
            return content
        side, quality = side * 3 // 4, max(quality - 8, 40)
