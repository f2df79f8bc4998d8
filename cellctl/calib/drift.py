"""Does something move while views are taken? Warm-up, creeping mounts, slips.

What pictures and robot disagree about is noise in one view, and a trend if it grows with the order
of the views, or jumps at one of them and stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cellctl.geometry import Array

LEAST_VIEWS = 6
SHUFFLES, CERTAIN = 400, 0.99
"""A trend must explain more than the best trend does in that part of so many shuffles of the
views, always the same ones. Errors that go with the robot's place are smooth, too,
but not along the order."""
SHARE = 0.4
"""And at least that part of the disagreements."""
CLIP = 2.0
TIE = 1.02
"""A ramp from the first view on is preferred to what explains no more than that factor more."""


@dataclass(frozen=True)
class Drift:
    """From view `since` on the board seems to move by `mm` and `deg` until the last view;
    `jump`: all at once."""

    since: str
    mm: float
    deg: float
    jump: bool

    def __str__(self) -> str:
        size = f"{self.mm:.1f} mm and {self.deg:.2f} deg"
        if self.jump:
            return f"from view {self.since!r} on the board is off by {size}: something slipped"
        return (
            f"in the order of the views the board drifts by {size}, from about view "
            f"{self.since!r} on: camera, robot or a mount was warming up or creeping"
        )


def find_drift(names: Sequence[str], turns: Array, shifts: Array, frames: Array) -> Drift | None:
    """The trend in how far the board was off in each view, or None.

    `turns`, `shifts` (n, 3): rotation vectors and metres, in the order of the views and in the
    frame that moves; `frames` (n, 3, 3): its rotation in the frame at rest. Something may move in
    either.
    """
    if len(names) < LEAST_VIEWS:
        return None
    shapes, starts = _shapes(len(names))
    best = None
    for R in (np.broadcast_to(np.eye(3), frames.shape), frames):
        moved = np.concatenate([_turned(R, turns), _turned(R, shifts)], axis=1)
        found = _trend(moved, shapes)
        if found is not None and (best is None or found[0] > best[0]):
            best = found
    if best is None:
        return None
    _, shape, change = best
    return Drift(
        since=names[starts[shape]],
        mm=float(1e3 * np.linalg.norm(change[3:])),
        deg=float(np.degrees(np.linalg.norm(change[:3]))),
        jump=shape >= len(shapes) - (len(names) - 3),
    )


def _turned(R: Array, vectors: Array) -> Array:
    return (R @ vectors[..., None])[..., 0]


def _shapes(n: int) -> tuple[Array, Array]:
    """Unit vectors (s, n) of mean zero: ramps that begin at a view, then jumps; and the number of
    the view (s,) with which each begins."""
    index = np.arange(n)
    ramp_starts, jump_starts = np.arange(n - 3), np.arange(2, n - 1)
    ramps = np.maximum(index - ramp_starts[:, None], 0.0)
    jumps = (index >= jump_starts[:, None]).astype(float)
    shapes = np.concatenate([ramps, jumps])
    shapes = shapes - shapes.mean(axis=1, keepdims=True)
    shapes /= np.linalg.norm(shapes, axis=1, keepdims=True)
    return shapes, np.concatenate([ramp_starts, jump_starts])


def _clipped(vectors: Array) -> Array:
    """(n, 3) in median lengths; what is longer than CLIP is shortened: one bad view is no trend,
    and hides none."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    limit = CLIP * max(float(np.median(lengths)), 1e-12)
    return CLIP * vectors / np.maximum(lengths, limit)


def _trend(moved: Array, shapes: Array) -> tuple[float, int, Array] | None:
    """Share that the best shape explains of the turns or of the shifts in (n, 6), which shape, and
    the change (6,) from its first to its last view; None when it may be chance."""
    off = moved - moved.mean(axis=0)
    raw = np.split(off, 2, axis=1)
    parts = np.stack([*raw, *(_clipped(part - np.median(part, axis=0)) for part in raw)])
    parts -= parts.mean(axis=1, keepdims=True)
    parts /= np.sqrt(np.square(parts).sum(axis=(1, 2), keepdims=True)) + 1e-12
    rng = np.random.default_rng(0)
    order = np.array([rng.permutation(len(off)) for _ in range(SHUFFLES)])
    explained = np.square(shapes @ parts).sum(axis=2)
    chance = np.square(shapes @ parts[:, order]).sum(axis=3).max(axis=(0, 2))
    if explained.max() < max(SHARE, float(np.quantile(chance, CERTAIN))):
        return None
    share = explained[: len(raw)].max(axis=0)
    best = 0 if share[0] * TIE >= share.max() else int(np.argmax(share))
    shape = shapes[best]
    return float(share[best]), best, (shape @ off) * float(np.ptp(shape))
