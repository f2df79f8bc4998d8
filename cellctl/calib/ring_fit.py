"""Thin dark rings fitted in a plane's own coordinates, many at once.

A circle on a plane is an ellipse in the picture whose centre is not the picture of the circle's
centre. So the line is sought along the circle's radii on the plane, sampled in the picture
through the true camera model, and the circle is fitted there: without bias from perspective or
lens as far as the plane's tilt is right.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from cellctl.calib.corners import sample
from cellctl.calib.plane_view import PlaneView
from cellctl.geometry import Array, Mask

BLUR_PX = 0.75
"""What a lens and a pixel's own width add to a line, standard deviation."""
OTHER_WIDTHS = (0.8, 1.0, 1.25, 1.6, 2.0, 2.5)
"""Lines may be that many times as wide as expected."""
STEP_PX = 0.5
SIDE = 1.7
"""The line's sides begin that many standard deviations off it."""
DIP = 0.3
"""A line is darker than both of its sides by that share of its depth."""
REACH = 2.6
"""Half the length of a profile, in standard deviations of the line."""
CLEAR = 4.0
"""Ink is darker than its sides by so many times the noise ..."""
PALE = 0.35
""" ... and by that share of the line's median depth."""
OFF_PX = 1.0
"""Ink that far off the fitted circle is not the circle's line."""
WIDTHS = (1.0,) * 5
"""Of the profiles of each round, in those of the line; wider ones find it from further away, but
run into neighbours."""
TUKEY = 4.7
LEAST_SCALE_PX = 0.04
CORRELATED_PX = 1.5
"""Profiles closer than that share their noise."""


@dataclass(frozen=True, eq=False)
class Picture:
    """`values` (h, w) float32 in which lines are dark; `noise`, its standard deviation in grey
    levels; `blind` (h, w) where the sensor was at its end, else None."""

    values: Array
    noise: float
    blind: Array | None = None


@dataclass(frozen=True, eq=False)
class Rings:
    """Fitted rings side by side: `centres` (n, 2) and `radii` (n,) in metres on the plane;
    `ink`, `hidden` (n,), shares of the circumference with ink, and that cannot be judged;
    `arc` (n,), share of the longest piece without a gap; `depth` (n,), the line's median depth
    in grey levels; `rms_px`, `sigma_px` (n,), of the
    line's points about the circle, and one standard deviation of the centre per axis."""

    centres: Array
    radii: Array
    ink: Array
    hidden: Array
    arc: Array
    depth: Array
    rms_px: Array
    sigma_px: Array

    def __getitem__(self, index: Array) -> Rings:
        return Rings(*(getattr(self, item.name)[index] for item in fields(self)))

    def __len__(self) -> int:
        return len(self.radii)

    @property
    def complete(self) -> Array:
        """(n,) share with ink of what can be judged."""
        return self.ink / np.maximum(1.0 - self.hidden, 1e-9)


@dataclass(frozen=True, eq=False)
class _Profiles:
    """Lines across each ring (n, k): `off` px outward of the circle, `depth` in grey levels,
    `dip`, by how much the line is darker than the darker one of its sides, `centre`, the grey
    level on the circle, `sides`, that of the paper beside it, `blind`."""

    off: Array
    depth: Array
    dip: Array
    centre: Array
    sides: Array
    blind: Mask


def line_sigma(line_m: float, pixel_m: float) -> float:
    """Standard deviation, pixels, of the bell that a line in focus makes."""
    return float(np.hypot(line_m / pixel_m / np.sqrt(12.0), BLUR_PX))


def seen_sigma(picture: Picture, view: PlaneView, rings: Rings, sigma: float) -> float:
    """The same as fitted rings show it: that of the bell most like the median profile, near what
    was expected, `sigma`. A lens out of focus or a worn pen makes wider lines."""
    clear = rings[np.flatnonzero(rings.ink > 0.5)]
    if not len(clear):
        return sigma
    pixel_m = view.pixel_m(clear.centres)
    reach = REACH * OTHER_WIDTHS[-2] * sigma
    t = np.arange(-np.ceil(reach / STEP_PX), np.ceil(reach / STEP_PX) + 1) * STEP_PX
    values, _ = _across(picture, view, clear, _spokes(36), pixel_m, t)
    profile = np.median(values - np.median(values, axis=2, keepdims=True), axis=(0, 1))
    left = []
    for width in OTHER_WIDTHS:
        bell = np.stack([np.ones_like(t), t, np.exp(-0.5 * np.square(t / width / sigma))], axis=-1)
        left.append(float(np.linalg.norm(profile - bell @ (np.linalg.pinv(bell) @ profile))))
    return sigma * OTHER_WIDTHS[int(np.argmin(left))]


def fit_rings(
    picture: Picture,
    view: PlaneView,
    centres: Array,
    radii: Array,
    sigma: float,
    *,
    angles: int,
    widths: tuple[float, ...] = WIDTHS,
) -> Rings:
    """Rings fitted from starts `centres` (n, 2), `radii` (n,), right to about a pixel or two;
    `sigma` is the line's, pixels."""
    if not len(radii):
        return Rings(centres, *np.zeros((7, 0)))
    spokes = _spokes(angles)
    design = np.column_stack([spokes, np.ones(angles)])
    pixel_m = view.pixel_m(centres)
    for width in widths:
        start = _Start(centres, radii)
        profiles = _profiles(picture, view, start, spokes, pixel_m, width * sigma)
        inked = _inked(profiles, picture.noise, OFF_PX * width)
        weights = _weights(profiles.off, inked, design)
        step = np.clip(_solve(design, weights, profiles.off), -2.0, 2.0) * pixel_m[:, None]
        centres, radii = centres + step[:, :2], np.maximum(radii + step[:, 2], 0.5 * radii)
    return _measured(profiles, inked, weights, design, centres, radii, pixel_m)


@dataclass(frozen=True, eq=False)
class _Start:
    centres: Array
    radii: Array


def _spokes(angles: int) -> Array:
    """(k, 2) directions all around."""
    theta = 2.0 * np.pi * np.arange(angles) / angles
    return np.stack([np.cos(theta), np.sin(theta)], axis=-1)


def _profiles(
    picture: Picture,
    view: PlaneView,
    start: _Start,
    spokes: Array,
    pixel_m: Array,
    sigma: float,
) -> _Profiles:
    """The line along every spoke, by least squares of a level, a slope, a bell and its shift."""
    count = int(np.ceil(REACH * sigma / STEP_PX))
    t = np.arange(-count, count + 1) * STEP_PX
    values, blind = _across(picture, view, start, spokes, pixel_m, t)
    level, _, depth, shift = np.moveaxis(values @ _bell_solver(t, sigma).T, -1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.where(depth > 0, shift / depth, np.nan)
    dip = _dip(values, np.abs(t) <= OFF_PX, np.abs(t) >= SIDE * sigma)
    return _Profiles(off, depth, dip, values[..., count], level, blind)


def _across(
    picture: Picture,
    view: PlaneView,
    rings: _Start | Rings,
    spokes: Array,
    pixel_m: Array,
    t: Array,
) -> tuple[Array, Mask]:
    """Grey levels (n, k, t) at t (an odd number, symmetric) pixels outward of each ring along its
    spokes (k, 2), and where (n, k) they cannot be told."""
    on_line = rings.centres[:, None] + rings.radii[:, None, None] * spokes
    outward = pixel_m[:, None, None, None] * t[[0, len(t) // 2, -1], None] * spokes[:, None]
    ends = view.pixels(on_line[:, :, None] + outward)
    pixels = np.nan_to_num(_parabolas(t / t[-1]) @ ends)
    blind = np.asarray(~view.inside(ends, 1.0).all(axis=-1))
    if picture.blind is not None:
        blind |= sample(picture.blind, pixels[:, :, len(t) // 2]) > 0.25
    return np.asarray(sample(picture.values, pixels), dtype=float), blind


def _dip(values: Array, on_line: Mask, beside: Mask) -> Array:
    """(n, k): how far profiles (n, k, t) go down within the line from their darker end. A
    shoulder of something bright, or a step, goes down on one side only."""
    half = values.shape[-1] // 2
    inner, outer = values[..., :half][..., beside[:half]], values[..., -half:][..., beside[-half:]]
    lowest = values[..., on_line].min(axis=-1)
    return np.minimum(inner.mean(axis=-1), outer.mean(axis=-1)) - lowest


def _parabolas(u: Array) -> Array:
    """(k, 3): weights of what stands at -1, 0 and 1 for u (k,) on the parabola through it.
    A straight line would do for all but perspective, which bends it by 0.005 px."""
    return np.stack([0.5 * u * (u - 1.0), 1.0 - u * u, 0.5 * u * (u + 1.0)], axis=-1)


def _bell_solver(t: Array, sigma: float) -> Array:
    """(4, k): from values at t (k,) to level, slope, depth and depth * shift of a dark line."""
    bell = np.exp(-0.5 * np.square(t / sigma))
    design = np.stack([np.ones_like(t), t, -bell, -bell * t / sigma**2], axis=-1)
    return np.linalg.pinv(design)


def _inked(profiles: _Profiles, noise: float, off_px: float) -> Mask:
    """(n, k): where the ring has its line."""
    depth = np.where(profiles.blind, 0.0, profiles.depth)
    clear = (depth > CLEAR * noise) & (profiles.dip > DIP * depth)
    usual = _median(np.where(clear, depth, np.nan))
    deep = depth > PALE * np.nan_to_num(usual, nan=np.inf)[:, None]
    with np.errstate(invalid="ignore"):
        return clear & deep & (np.abs(profiles.off) < off_px)


def _weights(off: Array, used: Mask, design: Array) -> Array:
    """Tukey's weights (n, k) of points about the circle that fits them, after a few rounds."""
    weights = used.astype(float)
    for _ in range(4):
        residual = off - _solve(design, weights, off) @ design.T
        residual = np.where(used, residual, np.nan)
        scale = 1.4826 * np.nan_to_num(_median(np.abs(residual)))
        scale = np.maximum(scale, LEAST_SCALE_PX)[:, None]
        share = np.nan_to_num(residual / (TUKEY * scale), nan=1.0)
        weights = np.where(np.abs(share) < 1.0, np.square(1.0 - np.square(share)), 0.0) * used
    return weights


def _median(values: Array) -> Array:
    """Of each row's known values; not-a-number where there are none."""
    ordered = np.sort(values, axis=1)
    known = np.isfinite(ordered).sum(axis=1)
    rows = np.arange(len(values))
    low, high = np.maximum(known - 1, 0) // 2, np.minimum(known // 2, values.shape[1] - 1)
    return 0.5 * (ordered[rows, low] + ordered[rows, high])


def _solve(design: Array, weights: Array, off: Array) -> Array:
    """(n, 3): shift and growth that explain offsets (n, k) with weights (n, k), held weakly."""
    normal = np.einsum("ka,nk,kb->nab", design, weights, design) + 1e-3 * np.eye(3)
    right = (weights * np.nan_to_num(off)) @ design
    return np.linalg.solve(normal, right[..., None])[..., 0]


def _measured(
    profiles: _Profiles,
    inked: Mask,
    weights: Array,
    design: Array,
    centres: Array,
    radii: Array,
    pixel_m: Array,
) -> Rings:
    """What the last profiles say about the fitted rings."""
    used = weights > 0
    count = np.maximum(used.sum(axis=1), 1)
    residual = np.where(used, profiles.off, 0.0) - (
        np.where(used, _solve(design, weights, profiles.off) @ design.T, 0.0)
    )
    rms = np.sqrt(np.square(residual).sum(axis=1) / np.maximum(count - 3, 1))
    normal = np.einsum("ka,nk,kb->nab", design, used.astype(float), design) + 1e-3 * np.eye(3)
    spread = np.trace(np.linalg.inv(normal)[:, :2, :2], axis1=1, axis2=2) / 2.0
    spacing = 2.0 * np.pi * radii / pixel_m / len(design)
    alike = np.maximum(CORRELATED_PX / spacing, 1.0)  # neighbours that share their noise
    depth = np.nan_to_num(_median(np.where(used, profiles.depth, np.nan)))
    hidden = _hidden(profiles, inked, depth)
    return Rings(
        centres=centres,
        radii=radii,
        ink=inked.mean(axis=1),
        hidden=hidden.mean(axis=1),
        arc=_longest(inked | hidden),
        depth=depth,
        rms_px=rms,
        sigma_px=rms * np.sqrt(spread * alike),
    )


def _hidden(profiles: _Profiles, inked: Mask, depth: Array) -> Mask:
    """(n, k): where no one can tell whether there is ink: beyond the picture, where the sensor
    was at its end, or where something else is as dark as the line is."""
    paper = _median(np.where(inked, profiles.sides, np.nan))
    dark = profiles.centre < (paper - 0.5 * depth)[:, None]
    return ~inked & (profiles.blind | dark)


def _longest(line: Mask) -> Array:
    """(n,): share of each circle (n, k) that its longest piece without a gap takes."""
    twice = np.concatenate([line, line], axis=1)
    number = np.arange(twice.shape[1])
    last_gap = np.maximum.accumulate(np.where(twice, -1, number), axis=1)
    return np.minimum((number - last_gap).max(axis=1) / line.shape[1], 1.0)
