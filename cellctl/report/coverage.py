"""How much of the picture and of the space of poses the recording covers: what lies outside is
extrapolated."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from markupsafe import Markup

from cellctl.geometry import Array
from cellctl.report.blocks import Block, Figures, Heading, Note, Section
from cellctl.report.phrases import plural
from cellctl.report.recorded import Recorded
from cellctl.report.svg import Scale, Svg, draw_axes, limits
from cellctl.report.views import (
    BoardView,
    board_views,
    camera_of,
    drawn_circles,
    held_out_keys,
    picture_size,
    shown_markers,
)

WIDTH = 420.0
BOARDS = (("intrinsic", "checkerboard"), ("hand-eye", "marker board"))
MOST_CORNERS = 2500
RINGS = (15, 30, 45, 60)


def section(recorded: Recorded) -> Section:
    """The picture's frame with all that was found in it, and the poses of the boards."""
    frames = list(_frames(recorded))
    blocks: list[Block] = []
    if frames:
        blocks += [Heading("In the camera's picture"), Figures(frames)]
    poses = [figure for part, board in BOARDS for figure in _poses(recorded, part, board)]
    if poses:
        blocks += [Heading("In the space of poses"), Figures(poses)]
    lead = (
        "A calibration is good where it was measured. The frame is the camera's picture; a board "
        "that fills it in many tilts, turns and distances leaves little to be guessed."
    )
    if not blocks:
        blocks.append(Note("Nothing was seen by the camera that could cover anything.", "missing"))
        lead = ""
    return Section("coverage", "What the recording covers", lead, blocks)


def _frames(recorded: Recorded) -> Any:
    """Drawings of the camera's picture, each with its caption."""
    for part, board in BOARDS:
        views = board_views(recorded, part)
        if views:
            yield _board_frame(recorded, views, part, board)
    markers = [centre for _, found in shown_markers(recorded) for centre in found.values()]
    if markers:
        words = f"projector: {plural(len(markers), 'projected marker')}"
        yield _point_frame(recorded, [("dot train", np.array(markers))], words)
    circles = [c for c in drawn_circles(recorded) if c.centre is not None]
    if circles:
        unseen = held_out_keys(recorded)
        sets = [
            (cls, np.array([c.centre for c in circles if (c.key in unseen) is held]))
            for cls, held in (("dot train", False), ("dot held", True))
        ]
        yield _point_frame(recorded, sets, f"draw: {plural(len(circles), 'circle')}")


def _size(recorded: Recorded, pixels: Array) -> tuple[float, float]:
    """Of the picture; when it is not known, of what was seen."""
    known = picture_size(recorded)
    return known or (max(float(pixels[:, 0].max()), 1.0), max(float(pixels[:, 1].max()), 1.0))


def _frame(size: tuple[float, float], name: str) -> tuple[Svg, float]:
    """An empty picture, and how many drawing units a pixel has."""
    scale = WIDTH / size[0]
    height = min(size[1] * scale, 3 * WIDTH)
    svg = Svg(WIDTH, height, name)
    svg.box((0.5, 0.5), (WIDTH - 0.5, height - 0.5), "frame", rx=3)
    return svg, scale


def _board_frame(
    recorded: Recorded, views: list[BoardView], part: str, board: str
) -> tuple[Markup, str]:
    corners = np.concatenate([view.pixels for view in views])
    size = _size(recorded, corners)
    svg, scale = _frame(size, f"{part}: the board in the camera's picture")
    for view in views:
        svg.polygon(hull(view.pixels) * scale, "board", view.key)
    svg.cloud(corners[:: max(1, len(corners) // MOST_CORNERS)] * scale, "corners")
    share = _covered(corners, size)
    return (
        svg.markup(),
        f"{part}: {plural(len(views), 'view')} of the {board}, {share} of the picture",
    )


def _point_frame(
    recorded: Recorded, sets: list[tuple[str, Array]], words: str
) -> tuple[Markup, str]:
    everything = np.concatenate([points.reshape(-1, 2) for _, points in sets])
    size = _size(recorded, everything)
    svg, scale = _frame(size, words)
    svg.polygon(hull(everything) * scale, "board")
    for cls, points in sets:
        for x, y in points.reshape(-1, 2) * scale:
            svg.dot((x, y), 2.2, cls)
    return svg.markup(), f"{words}, {_covered(everything, size)} of the picture"


def hull(points: Array) -> Array:
    """Corners (k, 2) of the convex hull of points (n, 2)."""
    return cv2.convexHull(points.astype(np.float32)).reshape(-1, 2).astype(float)


def _covered(points: Array, size: tuple[float, float]) -> str:
    area = float(cv2.contourArea(hull(points).astype(np.float32))) / (size[0] * size[1])
    return f"{min(area, 1.0):.0%}"


def _poses(recorded: Recorded, part: str, board: str) -> list[tuple[Markup, str]]:
    """A polar plot of tilts, and distance over the turn in the picture."""
    camera = camera_of(recorded, part)
    if camera is None:
        return []
    views = board_views(recorded, part)
    posed = [(view, pose) for view in views if (pose := view.pose(camera)) is not None]
    if not posed:
        return []
    keys = [view.key for view, _ in posed]
    centres = [(view.points.min(axis=0) + view.points.max(axis=0)) / 2 for view, _ in posed]
    poses = np.array([pose for _, pose in posed])
    tilt, towards, turn = angles(poses)
    away = np.array(
        [np.linalg.norm(T[:3, :3] @ c + T[:3, 3]) for T, c in zip(poses, centres, strict=True)]
    )
    told = f"{part}: tilt of the {board}, and which way it leans in the picture"
    return [
        (_polar(tilt, towards, keys), told),
        (_spread(turn, away, keys), f"{part}: turn in the picture and distance"),
    ]


def angles(poses: Array) -> tuple[Array, Array, Array]:
    """Of boards (n, 4, 4) in the optical frame, degrees: tilt of the normal against the optical
    axis, 0 to 90; the direction in the picture that it leans to, x right and y down; the turn of
    the board's x axis in the picture."""
    normals = poses[:, :3, 2] * -np.sign(poses[:, 2, 2])[:, None]
    tilt = np.degrees(np.arccos(np.clip(np.abs(normals[:, 2]), 0.0, 1.0)))
    towards = np.degrees(np.arctan2(normals[:, 1], normals[:, 0]))
    turn = np.degrees(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))
    return tilt, towards, turn


def _polar(tilt: Array, towards: Array, keys: list[str]) -> Markup:
    svg = Svg(WIDTH, 330, "tilts of the board")
    x, y, radius = WIDTH / 2, 165.0, 140.0
    outer = RINGS[-1] if not len(tilt) or tilt.max() <= RINGS[-1] else 90
    rings = [*RINGS, 75, 90] if outer == 90 else list(RINGS)
    for ring in rings:
        svg.dot((x, y), radius * ring / outer, "ring")
        svg.text((x + 4, y - radius * ring / outer + 12), f"{ring}\N{DEGREE SIGN}", "tick")
    svg.line((x - radius, y), (x + radius, y), "grid")
    svg.line((x, y - radius), (x, y + radius), "grid")
    for away, angle, key in zip(tilt, np.radians(towards), keys, strict=True):
        reach = radius * away / outer
        place = (x + reach * float(np.cos(angle)), y + reach * float(np.sin(angle)))
        svg.dot(place, 4.5, "mark train", f"{key}: tilted by {away:.0f} degrees")
    return svg.markup()


def _spread(turn: Array, away: Array, keys: list[str]) -> Markup:
    svg = Svg(WIDTH, 330, "turns and distances of the board")
    low, high = limits([float(v) for v in away], margin=0.15)
    x, y = Scale(-180, 180, 56, WIDTH - 14), Scale(max(low, 0.0), high, 280, 14)
    for tick in (-180, -90, 0, 90, 180):
        svg.line((x(tick), y.start), (x(tick), y.end), "grid")
        svg.text(
            (x(tick), y.start + 16),
            f"{tick}\N{DEGREE SIGN}".replace("-", "\N{MINUS SIGN}"),
            "tick",
            "middle",
        )
    svg.text((x(0), y.start + 36), "turn in the picture", "axis", "middle")
    draw_axes(svg, x, y, ("", "distance from the camera, m"))
    for degrees, metres, key in zip(turn, away, keys, strict=True):
        told = f"{key}: {metres:.2f} m, turned by {degrees:.0f} degrees"
        svg.dot((x(float(degrees)), y(float(metres))), 4.5, "mark train", told)
    return svg.markup()
