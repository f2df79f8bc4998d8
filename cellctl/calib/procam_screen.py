"""What is wrong with a single capture: seen before camera and projector are adjusted to it.

On a flat board, a homography leads from the print to the projector's picture. Points that it
does not explain were lit on something else, or were decoded wrongly; a homography that turns the
print over belongs to a mirrored picture.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cellctl.calib.pose import on_a_line
from cellctl.calib.procam_problem import Capture
from cellctl.calib.projector_map import apply_homography, direct_linear_transform
from cellctl.calib.views import Rejection
from cellctl.errors import SolveError
from cellctl.geometry import Array, Mask

MINIMUM_POINTS = 8
INLIERS = 0.6
"""Part of the board's points in the camera's picture whose projector pixel must be known and
agree."""
TOLERANCE = 0.01
"""Of the projector pixels that the points span: lenses bend, and paper bulges, by less."""
SURFACE = 0.15
"""Part of the points that on a plane of their own make a second surface."""
SAMPLES = 300


def screened(
    captures: Sequence[Capture], seen: dict[str, int]
) -> tuple[list[Capture], list[Rejection]]:
    """The captures with the points that lie on one plane, and those that cannot be used, with
    the reason. `seen`: how many corners the camera saw, by id.

    SolveError when most are mirrored: then the projector or the order of the pictures is at
    fault, not a capture.
    """
    kept: list[Capture] = []
    rejected: list[Rejection] = []
    turned: list[tuple[Capture, str]] = []
    for capture in captures:
        flat, why = _on_one_plane(capture, seen[capture.id])
        if flat is None:
            rejected.append(Rejection(capture.id, why))
        elif why := mirrored(flat):
            turned.append((flat, why))
        else:
            kept.append(flat)
    if len(turned) > len(kept):
        raise SolveError(
            f"the projection is {turned[0][1]} in {', '.join(c.id for c, _ in turned)}: only a "
            "negative focal length would explain it; switch off the projector's rear or ceiling "
            "mode, and check that neither pictures nor code were flipped",
            rejected=[
                *(r.to_dict() for r in rejected),
                *({"id": c.id, "reason": f"the projection is {why}"} for c, why in turned),
            ],
        )
    rejected += [
        Rejection(c.id, f"the projection is {why}; in others it is not") for c, why in turned
    ]
    return kept, sorted(rejected, key=lambda rejection: rejection.id)


def mirrored(capture: Capture) -> str:
    """In words how the camera sees the projector's picture turned over; empty when it does not."""
    slope = np.median(capture.slopes, axis=0)
    if np.linalg.det(slope) > 0:
        return ""
    return (
        "upside down (mirrored, top and bottom swapped)"
        if _upright(slope)
        else ("mirrored (left and right swapped)")
    )


def half_turned(captures: Sequence[Capture]) -> bool:
    """Whether the camera sees the projector's picture upside down, by half a turn."""
    slope = np.median(np.concatenate([capture.slopes for capture in captures]), axis=0)
    return bool(np.linalg.det(slope) > 0 and np.trace(slope) < 0)


def _upright(slope: Array) -> bool:
    """Of a mirrored slope: whether left stays left."""
    return bool(slope[0, 0] > slope[1, 1])


def _on_one_plane(capture: Capture, seen: int) -> tuple[Capture | None, str]:
    """The points on the plane that most share; None and the reason when they are too few."""
    read = len(capture.points)
    least = max(MINIMUM_POINTS, INLIERS * seen)
    if read < least:
        return None, (
            f"too few inliers: the code could be read at only {read} of {seen} corners of the "
            "board: is it lit wholly, neither in shadow nor saturated?"
        )
    if on_a_line(capture.points):
        return None, "all points read lie on one line of the board"
    on_plane = _consensus(capture)
    second = _second(capture[~on_plane])
    if on_plane.sum() >= MINIMUM_POINTS and second >= max(MINIMUM_POINTS, SURFACE * read):
        return None, (
            f"several surfaces: {on_plane.sum()} of the board's points were lit on one plane, "
            f"{second} on another; keep everything else out of the beam"
        )
    if on_plane.sum() >= least:
        return capture[on_plane], ""
    return None, (
        f"too few inliers: only {on_plane.sum()} of {read} points agree with a flat board: were "
        "its pictures mixed up with another capture's, or did it move in between?"
    )


def _second(rest: Capture) -> int:
    """How many of the points that are not on the main plane share one of their own."""
    if len(rest.points) < MINIMUM_POINTS or on_a_line(rest.points):
        return 0
    return int(_consensus(rest).sum())


def _consensus(capture: Capture) -> Mask:
    """The points (n,) that one homography from board to projector explains best: as
    projector._consensus does."""
    points, pixels = capture.points[:, :2], capture.projector_px
    tolerance = TOLERANCE * float(np.linalg.norm(np.ptp(pixels, axis=0))) + 0.5
    rng = np.random.default_rng(0)
    picks = np.array([rng.choice(len(points), 4, replace=False) for _ in range(SAMPLES)])
    best, best_cost = np.zeros(len(points), dtype=bool), np.inf
    with np.errstate(all="ignore"):
        for H in direct_linear_transform(points[picks], pixels[picks]):
            off = np.linalg.norm(apply_homography(H, points) - pixels, axis=1)
            off = np.where(np.isfinite(off), off, np.inf)
            cost = float(np.square(np.minimum(off, tolerance)).sum())
            if cost < best_cost:
                best, best_cost = off < tolerance, cost
    return best
