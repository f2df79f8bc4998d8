"""What is wrong with hand-eye views as a whole, and with those that do not belong.

Each usual mistake is tried as an explanation: would the views fit if the mount were the other one,
the poses inverted, their list shifted? Right poses fit to a millimetre and a tenth of a degree,
wrong ones are off by many times that, so there is little to weigh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cellctl.calib.closed_form import (
    LEVER_M,
    Consensus,
    consistent_options,
    discrepancies,
    scaled_start,
)
from cellctl.calib.hand_eye_fit import Mount, Possible
from cellctl.calib.printed import turns
from cellctl.calib.views import Rejection, RobotView
from cellctl.errors import SolveError
from cellctl.geometry import Array, invert

DOUBT_M, DOUBT_RAD = 0.01, np.radians(1.0)
"""Other explanations are tried when the median view is off by more than either."""
HOPELESS_M, HOPELESS_RAD = 0.05, np.radians(5.0)
"""Nothing is solved when the median view is off by more than either, and nothing explains it."""
BETTER = 5.0
"""An explanation has to fit that many times better."""
RESCALED = 0.05
"""A board is another one when its size differs by more than this part; what is less, a printer
does, and the adjustment finds it out better."""
UNITS = {1e-3: ("large", "the board's lengths"), 1e3: ("small", "the poses")}
FITS_M, FITS_RAD, FITS_MEDIANS = 0.005, np.radians(0.5), 5.0
"""A picture fits a pose that is off by less, or by less than so many times the median view."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """Flange poses (n, 4, 4) as reported, and the poses of the board that each picture allows."""

    names: list[str]
    flanges: Array
    possible: list[Array]
    mount: Mount

    @classmethod
    def of(cls, found: Sequence[Possible], mount: Mount) -> Evidence:
        flanges = np.stack([options[0][0].T_base_flange.matrix for options in found])
        names = [options[0][0].id for options in found]
        return cls(
            names, flanges, [np.stack([p.matrix for _, p in options]) for options in found], mount
        )

    def start(self, flanges: Array) -> Consensus | None:
        """How well the pictures would fit other poses; None when those determine nothing."""
        A = flanges if self.mount == "eye-to-hand" else invert(flanges)
        chosen = consistent_options(A, self.possible)
        C = np.stack([poses[i] for poses, i in zip(self.possible, chosen, strict=True)])
        try:
            return scaled_start(A, C)
        except SolveError:
            return None


def require_sense(evidence: Evidence, own: Consensus) -> None:
    """SolveError names the mistake, and what to do, when the views as stated do not fit
    (`own` is how well they do) and would if one mistake were undone; or when nothing fits."""
    if own.scale < 0 and not _off(own, DOUBT_M, DOUBT_RAD):
        raise SolveError(
            "the pictures are mirrored: they fit the robot's motion only as seen in a mirror; "
            "take them without flipping"
        )
    if not _off(own, DOUBT_M, DOUBT_RAD):
        return
    for mistake in _mistakes(evidence):
        other = evidence.start(mistake.flanges)
        if other is None or _off(other, DOUBT_M, DOUBT_RAD):
            continue
        if _score(other) * BETTER < _score(own):
            raise SolveError(mistake.words, views=mistake.views)
    if _off(own, HOPELESS_M, HOPELESS_RAD):
        raise SolveError(
            f"pictures and robot poses do not belong together: the median view is off by "
            f"{1e3 * own.shift:.0f} mm and {np.degrees(own.angle):.1f} deg. Check that each pose "
            "is that of its picture, and how the poses were written: degrees taken for radians, "
            "or another order of angles, look like this"
        )


def _off(start: Consensus, metres: float, radians: float) -> bool:
    return _shift(start) > metres or start.angle > radians


def _shift(start: Consensus) -> float:
    """In true metres if poses came in a smaller unit."""
    return start.shift / max(abs(start.scale), 1.0)


def _score(start: Consensus) -> float:
    return _shift(start) + LEVER_M * start.angle


@dataclass(frozen=True, eq=False)
class _Mistake:
    """What to say of it, and of each view by its id; the poses (n, 4, 4) if it is undone."""

    words: str
    flanges: Array
    views: dict[str, str]


def _mistakes(evidence: Evidence) -> list[_Mistake]:
    F, stated = evidence.flanges, evidence.mount
    transposed = F.copy()
    transposed[:, :3, :3] = np.swapaxes(F[:, :3, :3], 1, 2)
    other = "eye-in-hand" if stated == "eye-to-hand" else "eye-to-hand"
    forms = {
        f"the views fit if the mount is {other}, not {stated}: state that; or, if the mount is "
        "right, the poses are inverted (T_flange_base): write T_base_flange": invert(F),
        "the views fit if every pose's rotation is transposed: write T_base_flange row by row, "
        "p_base = T_base_flange p_flange": transposed,
    }
    n = np.arange(len(F))
    shifted = (
        "every pose belongs to the picture {} it, in the order of the ids: the list of poses is "
        "shifted by one against the pictures; pair them again"
    )
    orders = {
        shifted.format("before"): np.roll(n, -1),
        shifted.format("after"): np.roll(n, 1),
        "the poses are in the reverse order of the pictures: pair them again": n[::-1],
    }
    return [
        *(_Mistake(words, poses, {}) for words, poses in forms.items()),
        *(
            _Mistake(words, F[order], _paired(evidence.names, order))
            for words, order in orders.items()
        ),
    ]


def _paired(names: Sequence[str], order: Array) -> dict[str, str]:
    """Of each view, whose pose its picture fits."""
    return {
        name: f"its picture fits the pose of view {names[i]!r}"
        for name, i in zip(names, order, strict=True)
    }


def board_factor(start: Consensus) -> float:
    """By how much to multiply the stated board before anything is fitted: one, unless it is
    another board. SolveError when its unit, or that of the poses, is wrong."""
    for factor, (size, what) in UNITS.items():
        if abs(np.log(abs(start.scale) / factor)) < np.log(2.0):
            raise SolveError(
                f"the board as stated is 1000 times too {size} for the robot's motion: {what} "
                "seem to be in millimetres; state metres"
            )
    return start.scale if abs(start.scale - 1.0) > RESCALED else 1.0


@dataclass(frozen=True, eq=False)
class SolvedChain:
    """A solved chain: X and Y (4, 4) of A Y = X C, and how far off its median view is."""

    X: Array
    Y: Array
    mount: Mount
    shift: float
    angle: float

    def fits(self, flange: Array, possible: Array, turn: Array | None = None) -> bool:
        """Whether one of the possible poses (m, 4, 4) of the board goes with a flange pose, the
        board being turned on its mount if so told."""
        A = flange if self.mount == "eye-to-hand" else invert(flange)
        Y = self.Y if turn is None else self.Y @ turn
        shifts, angles = discrepancies(self.X, Y, A[None], possible)
        near = max(FITS_M, FITS_MEDIANS * self.shift)
        alike = max(FITS_RAD, FITS_MEDIANS * self.angle)
        return bool(np.any((shifts < near) & (angles < alike)))


def explained(
    chain: SolvedChain,
    rejected: Sequence[Rejection],
    views: Sequence[RobotView],
    possible: dict[str, Array],
    points: Array,
) -> list[Rejection]:
    """The rejections, with what has happened to a view where it can be told: whose pose its
    picture fits, and whether the board was turned. `possible` are the poses of the board by
    view; `points` (n, 3) those of the whole board."""
    flanges = {view.id: view.T_base_flange.matrix for view in views if view.id in possible}
    half_turn = turns(points, 2)[1]
    fits = {
        r.id: [n for n, flange in flanges.items() if chain.fits(flange, possible[r.id])]
        for r in rejected
        if r.id in flanges
    }
    found = []
    for one in rejected:
        words = ""
        if one.id in flanges and one.id not in fits[one.id]:
            turned = chain.fits(flanges[one.id], possible[one.id], half_turn)
            words = _what_happened(one.id, fits, turned=turned)
        found.append(Rejection(one.id, one.reason + words))
    return found


def _what_happened(name: str, fits: dict[str, list[str]], *, turned: bool) -> str:
    if turned:
        return "; it fits if the board was turned by half a turn on its mount"
    others = fits[name]
    for other in others:
        if name in fits.get(other, []):
            return (
                f"; exchanging the poses of views {name!r} and {other!r} would fit: they were "
                "swapped"
            )
    if others:
        return f"; its picture fits the pose of view {others[0]!r}: the views were mislabelled"
    return "; its picture fits no pose of the others either: leave it out or take it again"
