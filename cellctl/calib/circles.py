"""Finding circles that a pen drew, or a projector shows, on a plane: where their centres are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike

from cellctl.calib.camera import CameraModel
from cellctl.calib.plane_view import PlaneView, flatten
from cellctl.calib.printed import Unseen
from cellctl.calib.ring_fit import Picture, Rings, fit_rings, line_sigma, seen_sigma
from cellctl.calib.ring_match import match_rings
from cellctl.calib.ring_votes import Candidates, thin_lines, vote
from cellctl.errors import BadInput, SolveError
from cellctl.geometry import Array, Mask

Polarity = Literal["dark", "bright"]

WHOLE = 0.85
"""Share of the line that must carry ink, of what can be judged."""
JUDGED = 0.6
"""Share of the line that must carry ink at all."""
HALF = 0.4
"""With less ink than that, what is there need not be the circle."""
ARC = 0.5
"""Share of its ink that a half-drawn circle has in one piece; chance lines have less."""
RADII = (0.5, 1.5)
"""Circles of that many times the commanded radius are told."""
RADIUS_STEP_PX, RADIUS_STEP = 1.0, 0.06
EACH = 10
"""So many rings at most are looked at for each expected one."""
WEAKER = 0.35
"""... and none that has less than that share of the best one's votes."""
ROUND_PX = 0.3
"""A line that leaves the fitted circle by more, rms, is no circle; noise adds to it. A pen's
tremor is a tenth of a pixel, and so is the plane's tilt when it is wrong by 10 degrees."""
SAME_PX = 2.0
LEAST_RADIUS_PX = 3.0
ANGLES = (64, 160)
COARSE_ANGLES, COARSE_WIDTHS = 36, (1.15, 1.0, 1.0)
SATURATED = 249.0
LEAST_NOISE = 0.3


@dataclass(frozen=True, eq=False)
class Expected:
    """A circle that was drawn or shown about `centre` (2,), metres on the plane."""

    key: str
    centre: ArrayLike
    radius_m: float


@dataclass(frozen=True, eq=False)
class Circle:
    """A circle in a picture. `centre_px` (2,) is the picture of the circle's centre, raw pixels,
    and `xy` (2,) the same in undistorted normalised coordinates; `place` (2,) and `radius_m` are
    metres on the plane as T_camera_plane has it.

    `seen`: share of its line with ink; `contrast`: how much darker the line is than its sides,
    grey levels; `rms_px`: of the line's points about the circle; `sigma_px`: one standard
    deviation of the centre per axis.
    """

    centre_px: Array
    xy: Array
    place: Array
    radius_m: float
    rms_px: float
    seen: float
    sigma_px: float
    contrast: float


def find_circles(
    image: Any,
    camera: CameraModel,
    T_camera_plane: ArrayLike,
    expected: Sequence[Expected],
    *,
    search_m: float,
    line_m: float,
    polarity: Polarity = "dark",
    before: Any = None,
) -> dict[str, Circle | Unseen]:
    """Each expected circle's key, with the circle or with why it is not seen.

    `image` (h, w) grey or (h, w, 3) BGR, uint8 or, averaged, float32 in grey levels. The plane's
    pose `T_camera_plane` (4, 4) and the expected centres may be off so that circles stand up to
    `search_m` from where they are expected, most of them alike; `line_m` is the width of the
    line. What shows in `before`, a picture of the same view in the same light, does not count.

    A circle of another radius is told with its own (from half to one and a half of the
    commanded one) when no better one is there. The centre is unbiased by perspective as far as
    the plane's tilt is right: an error d of the tilt (rad) shifts it by about r^2 d / depth.

    Raises BadInput for what cannot be read and SolveError when the camera does not look at the
    plane.
    """
    keys, centres, radii = _checked(expected, search_m, line_m)
    view = PlaneView(camera, T_camera_plane)
    picture = _picture(image, before, camera, polarity)
    if not keys:
        return {}
    if (view.depths(centres) <= 0).any():
        behind = keys[int(np.argmin(view.depths(centres)))]
        raise SolveError(f"T_camera_plane: the circle {behind!r} would be behind the camera")
    answer: dict[str, Circle | Unseen] = dict.fromkeys(keys, Unseen(OUTSIDE))
    visible = np.flatnonzero(view.inside(view.pixels(centres)))
    if len(visible):
        wanted = _Wanted(centres[visible], radii[visible], search_m, line_m)
        rings = _rings(picture, view, wanted)
        for i, ring in zip(visible, _matched(wanted, rings), strict=True):
            answer[keys[i]] = _answer(rings, int(ring), view)
    return answer


OUTSIDE = "the circle should be outside the picture"
NO_INK = "no ink where the circle should be"


@dataclass(frozen=True, eq=False)
class _Wanted:
    """Expected circles side by side: centres (n, 2), radii (n,), metres on the plane."""

    centres: Array
    radii: Array
    search_m: float
    line_m: float


def _matched(wanted: _Wanted, rings: Rings) -> Array:
    """(n,) the number of each expected circle's ring, or -1."""
    return match_rings(
        wanted.centres, wanted.radii, rings.centres, rings.radii, _whole(rings), wanted.search_m
    )


def _rings(picture: Picture, view: PlaneView, wanted: _Wanted) -> Rings:
    """Every ring near an expected one, fitted; also unfinished ones."""
    candidates = _candidates(picture, view, wanted)
    candidates = candidates[np.isfinite(view.pixel_m(candidates.centres))]
    pixel_m = float(np.median(view.pixel_m(wanted.centres)))
    sigma = line_sigma(wanted.line_m, pixel_m)
    coarse = fit_rings(
        picture,
        view,
        candidates.centres,
        candidates.radii,
        sigma,
        angles=COARSE_ANGLES,
        widths=COARSE_WIDTHS,
    )
    coarse = coarse[_distinct(coarse, view, coarse.ink > HALF / 2)]
    sigma = seen_sigma(picture, view, coarse, sigma)
    angles = int(np.clip(2.0 * np.pi * np.median(wanted.radii) / pixel_m, *ANGLES))
    fine = fit_rings(picture, view, coarse.centres, coarse.radii, sigma, angles=angles)
    allowed = ROUND_PX + picture.noise / np.maximum(fine.depth, picture.noise)
    sound = (fine.rms_px < allowed) & (fine.ink > HALF / 2)
    return fine[_distinct(fine, view, sound)]


def _candidates(picture: Picture, view: PlaneView, wanted: _Wanted) -> Candidates:
    """Where the picture's lines vote for rings: the best few about each expected one."""
    reach = wanted.search_m + RADII[1] * wanted.radii.max() + 4.0 * wanted.line_m
    seen_low, seen_high = view.extent()
    low = np.maximum(wanted.centres.min(axis=0) - reach, seen_low)
    high = np.minimum(wanted.centres.max(axis=0) + reach, seen_high)
    cell_m = float(view.pixel_m(wanted.centres).min())
    flat = flatten(view, picture.values, low, high, cell_m)
    if wanted.radii.min() < LEAST_RADIUS_PX * flat.cell_m:
        raise SolveError(
            f"circles of {1e3 * wanted.radii.min():.1f} mm radius are too small to be found in "
            f"{high[0] - low[0]:.1f} x {high[1] - low[1]:.1f} m: is search_m or the pose wrong?"
        )
    near = np.zeros(flat.values.shape, np.uint8)
    for column, row in np.rint(flat.cells(wanted.centres)).astype(int):
        cv2.circle(near, (column, row), int(wanted.search_m / flat.cell_m) + 1, 1, -1)
    found = vote(thin_lines(flat, wanted.line_m), flat, _radii(wanted, flat.cell_m), near > 0)
    gaps = np.linalg.norm(found.centres[None] - wanted.centres[:, None], axis=-1)
    votes = np.where(gaps <= wanted.search_m + 2.0 * flat.cell_m, found.votes, 0.0)
    votes[votes < WEAKER * votes.max(axis=1, keepdims=True, initial=0.0)] = 0.0
    best = np.argsort(-votes, axis=1)[:, :EACH]
    kept = best[np.take_along_axis(votes, best, axis=1) > 0]
    return found[np.unique(kept)]


def _radii(wanted: _Wanted, cell_m: float) -> Array:
    """Radii (k,) to try, about every commanded one: as near to each other as a fit reaches."""
    low = max(RADII[0] * float(wanted.radii.min()), LEAST_RADIUS_PX * cell_m)
    high = RADII[1] * float(wanted.radii.max())
    tried = [low]
    while tried[-1] < high:
        tried.append(tried[-1] + max(RADIUS_STEP_PX * cell_m, RADIUS_STEP * tried[-1]))
    radii = np.array(tried)
    relative = radii / wanted.radii[:, None]
    return radii[((relative >= 0.9 * RADII[0]) & (relative <= 1.1 * RADII[1])).any(axis=0)]


def _distinct(rings: Rings, view: PlaneView, sound: Mask) -> Array:
    """Numbers of the sound rings without those that repeat a better one."""
    order = np.flatnonzero(sound)
    order = order[np.argsort(-rings.ink[order], kind="stable")]
    near = SAME_PX * view.pixel_m(rings.centres)
    kept: list[int] = []
    for i in order:
        gap = np.linalg.norm(rings.centres[kept] - rings.centres[i], axis=1)
        growth = np.abs(rings.radii[kept] - rings.radii[i])
        if not ((gap < near[i]) & (growth < near[i])).any():
            kept.append(int(i))
    return np.array(sorted(kept), dtype=int)


def _whole(rings: Rings) -> Mask:
    return (rings.complete >= WHOLE) & (rings.ink >= JUDGED)


def _answer(rings: Rings, number: int, view: PlaneView) -> Circle | Unseen:
    if number < 0:
        return Unseen(NO_INK)
    ink, hidden = float(rings.ink[number]), float(rings.hidden[number])
    if not _whole(rings)[number]:
        if ink + hidden >= WHOLE and hidden > 0.15:
            return Unseen(f"glare or print hides {100 * hidden:.0f} % of its line")
        if ink < HALF or rings.arc[number] < ARC * rings.complete[number]:
            return Unseen(f"{NO_INK}, but for pieces of lines along {100 * ink:.0f} % of one")
        return Unseen(f"half drawn: ink on {100 * rings.complete[number]:.0f} % of its line")
    place = rings.centres[number]
    centre_px = view.pixels(place)
    return Circle(
        centre_px=centre_px,
        xy=view.camera.normalise(centre_px),
        place=place,
        radius_m=float(rings.radii[number]),
        rms_px=float(rings.rms_px[number]),
        seen=ink,
        sigma_px=float(rings.sigma_px[number]),
        contrast=float(rings.depth[number]),
    )


def _picture(image: Any, before: Any, camera: CameraModel, polarity: Polarity) -> Picture:
    """The picture in which the line is dark, whatever it is in `image`."""
    if polarity not in ("dark", "bright"):
        raise BadInput(f"polarity must be 'dark' or 'bright', not {polarity!r}")
    values = _grey(image, "the picture", camera)
    blind = values > SATURATED
    if before is not None:
        earlier = _grey(before, "the picture from before", camera)
        blind |= earlier > SATURATED
        values = values - earlier
    if polarity == "bright":
        return Picture(-values, _noise(values))
    return Picture(values, _noise(values), blind.astype(np.float32) if blind.any() else None)


def _grey(image: Any, what: str, camera: CameraModel) -> Array:
    """(h, w) float32; BadInput unless it is a picture that this camera took."""
    if not isinstance(image, np.ndarray) or image.dtype not in (np.uint8, np.float32, np.float64):
        kind = image.dtype if isinstance(image, np.ndarray) else type(image).__name__
        raise BadInput(f"{what} must be an array of uint8 or float32, not {kind}")
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
        raise BadInput(f"{what} must be (h, w) grey or (h, w, 3) BGR, not {image.shape}")
    w, h = camera.image_size
    if image.shape[:2] != (h, w):
        raise BadInput(
            f"{what} has {image.shape[1]}x{image.shape[0]} pixels, the camera's have {w}x{h}"
        )
    values = image.astype(np.float32)
    if not np.isfinite(values).all():
        raise BadInput(f"{what} holds values that are not finite")
    return cv2.cvtColor(values, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else values


def _noise(values: Array) -> float:
    """Standard deviation of a pixel's noise, from second differences along some rows."""
    rows = values[:: max(1, len(values) // 64)]
    bend = np.abs(rows[:, 2:] - 2.0 * rows[:, 1:-1] + rows[:, :-2])
    return max(LEAST_NOISE, float(np.median(bend)) * 1.4826 / np.sqrt(6.0))


def _checked(
    expected: Sequence[Expected], search_m: float, line_m: float
) -> tuple[list[str], Array, Array]:
    """Keys, centres (n, 2) and radii (n,)."""
    for name, value in (("search_m", search_m), ("line_m", line_m)):
        if not _positive(value):
            raise BadInput(f"{name} must be a positive length in metres, not {value!r}")
    centres = []
    for item in expected:
        try:
            centre = np.array(item.centre, dtype=float)
        except (TypeError, ValueError):
            centre = np.zeros(0)
        if centre.shape != (2,) or not np.isfinite(centre).all():
            raise BadInput(f"circle {item.key!r}: centre must be two finite numbers, metres")
        if not _positive(item.radius_m):
            raise BadInput(f"circle {item.key!r}: radius_m must be positive: {item.radius_m!r}")
        centres.append(centre)
        if line_m > item.radius_m:
            raise BadInput(f"circle {item.key!r}: line_m is wider than its radius")
    keys = [item.key for item in expected]
    if len(set(keys)) < len(keys):
        raise BadInput("two expected circles carry the same key")
    return keys, np.reshape(centres, (-1, 2)), np.array([item.radius_m for item in expected])


def _positive(value: Any) -> bool:
    number = isinstance(value, int | float | np.floating) and not isinstance(value, bool)
    return number and bool(np.isfinite(value)) and value > 0
