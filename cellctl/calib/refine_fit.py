"""Least squares of one family of corrections, and of the pen's offset, from drawn circles.

The robot draws at (x, y) with its tool turned by psi about the table's normal. The pen then
stands at (x, y) + (R(psi) - R(0)) t in the world frame, t (2,) being the pen's offset from where
the controller believes its tip, in world axes at the drawing posture psi = 0: circles drawn at
several yaws tell t from a shift of the table. What the chain makes of that place, corrected, is
compared with where the camera saw the circle's centre.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cellctl.calib.calibration import Calibration
from cellctl.calib.projector_map import apply_homography, homography_jacobian
from cellctl.calib.refinement import Refinement, homography_slopes, kernel_values, monomials
from cellctl.calib.smoothing import Smoother, smoother
from cellctl.errors import BadInput
from cellctl.geometry import Array

TCP_PRIOR_MM, MARK_SIGMA_MM = 20.0, 0.2
"""Per axis. The prior is loose: a tight one drags a pen that is off by millimetres."""
LARGEST_CONDITION = 30.0
STEPS, NEGLIGIBLE_STEP = 12, 1e-6


@dataclass(frozen=True, eq=False)
class Mark:
    """A circle that was drawn: commanded world `xy` (2,) in metres at the tool's `yaw` in rad,
    its centre `seen` (2,) in undistorted normalised camera coordinates, and its round, from 1."""

    key: str
    xy: Array
    yaw: float
    seen: Array
    round: int = 1


@dataclass(frozen=True, eq=False)
class Family:
    """`entries` (8, p): how the parameters move H's first eight entries about the identity.
    `monomials` counts those of higher degree. Allowed from `least` marks. `known`: the parameters
    are in standard deviations of what was known of them before. `field_mm`: the prior standard
    deviation of a monomial's coefficient, millimetres on the table; infinite: there is no prior."""

    name: str
    least: int
    entries: Array
    monomials: int = 0
    kernel: str = "none"
    known: bool = False
    field_mm: float = np.inf


def _entries(*columns: dict[int, float]) -> Array:
    entries = np.zeros((8, len(columns)))
    for j, column in enumerate(columns):
        entries[list(column), j] = list(column.values())
    return entries


_AFFINE = np.eye(8, 6)
FAMILIES = (
    Family("none", 0, _entries()),
    Family("shift", 4, _entries({2: 1.0}, {5: 1.0})),
    Family("similarity", 6, _entries({2: 1.0}, {5: 1.0}, {0: 1.0, 4: 1.0}, {1: -1.0, 3: 1.0})),
    Family("affine", 8, _AFFINE),
    Family("projective", 12, np.eye(8)),
    Family("quadratic", 24, _AFFINE, monomials=3),
    Family("rbf", 24, _AFFINE, kernel="rbf"),
    Family("thin-plate", 24, _AFFINE, kernel="thin-plate"),
    Family("cubic", 50, _AFFINE, monomials=7),
)
"""In order of preference."""


@dataclass(frozen=True, eq=False)
class Marks:
    """Marks as arrays: `xy` (n, 2) m, `turn` (n, 2, 2) = R(yaw) - R(0), `seen` (n, 2), `mm`
    (n, 2, 2), millimetres on the table by a unit of the camera's plane, at the circles; and
    `table` (3, 3), the homography from world (x, y) in metres to camera coordinates."""

    keys: tuple[str, ...]
    xy: Array
    turn: Array
    seen: Array
    mm: Array
    table: Array

    @classmethod
    def of(cls, marks: Sequence[Mark], base: Calibration) -> Marks:
        """BadInput when a key comes twice or a number is not finite."""
        keys = tuple(mark.key for mark in marks)
        twice = {key for key in keys if keys.count(key) > 1}
        if twice:
            raise BadInput(f"the circle {min(twice)!r} is listed more than once")
        for mark in marks:
            if not np.isfinite([*mark.xy, mark.yaw, *mark.seen]).all():
                raise BadInput(f"the circle {mark.key!r} has a coordinate that is not finite")
        yaw = np.array([mark.yaw for mark in marks], dtype=float)
        xy = np.array([mark.xy for mark in marks], dtype=float).reshape(-1, 2)
        seen = np.array([mark.seen for mark in marks], dtype=float).reshape(-1, 2)
        table = base.table_homography
        mm = 1e3 * homography_slopes(np.linalg.inv(table), seen)
        return cls(keys, xy, rotations(yaw) - np.eye(2), seen, mm, table)

    def __len__(self) -> int:
        return len(self.keys)

    def __getitem__(self, index: Any) -> Marks:
        keys = tuple(np.array(self.keys, dtype=object)[index])
        xy, turn, seen, mm = self.xy, self.turn, self.seen, self.mm
        return Marks(keys, xy[index], turn[index], seen[index], mm[index], self.table)

    def upright_at(self, xy: Array) -> Marks:
        """Circles without noise at world places (n, 2) in the drawing posture, as the unrefined
        chain has them."""
        seen = apply_homography(self.table, xy)
        mm = 1e3 * homography_slopes(np.linalg.inv(self.table), seen)
        keys = tuple(str(i) for i in range(len(xy)))
        return Marks(keys, xy, np.zeros((len(xy), 2, 2)), seen, mm, self.table)

    def stand(self, tcp: Array) -> Array:
        """World places (n, 2), metres, of a pen that is off by tcp (2,) metres."""
        return self.xy + self.turn @ tcp

    def chain(self, tcp: Array) -> Array:
        """Camera coordinates (n, 2) where the unrefined chain has the circles."""
        return apply_homography(self.table, self.stand(tcp))

    def on_table_mm(self, xy: Array) -> Array:
        """World (x, y) in millimetres of camera coordinates (n, 2)."""
        return 1e3 * apply_homography(np.linalg.inv(self.table), xy)


def rotations(yaw: Array) -> Array:
    """(n, 2, 2) turns by yaw (n,) about the table's normal."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)


@dataclass(frozen=True, eq=False)
class Frame:
    """Centre and scale that all fits to the same marks share, and the scale's millimetres."""

    centre: Array
    scale: float
    mm: float

    @classmethod
    def of(cls, marks: Marks) -> Frame:
        """The seen centres fill the square from -1 to 1."""
        low, high = marks.seen.min(axis=0), marks.seen.max(axis=0)
        scale = max(float((high - low).max()) / 2, 1e-6)
        mm = scale * float(np.sqrt(np.abs(np.linalg.det(marks.mm)).mean()))
        return cls((low + high) / 2, scale, mm)


@dataclass(frozen=True, eq=False)
class Fit:
    """A refinement with the pen's offset `tcp` (2,), metres, that goes with it.

    `normal` is A^T A + diag(penalty) in square millimetres with A (2n, p + 2), tcp in mm coming
    last; `count` is n; `smooth` the radial functions, where there are any.
    """

    refinement: Refinement
    tcp: Array
    normal: Array
    penalty: Array
    count: int
    smooth: Smoother | None = None

    @property
    def freedom(self) -> float:
        """Degrees of freedom that the errors keep: 2n less the trace of the hat matrix."""
        spared = self.penalty @ np.linalg.inv(self.normal).diagonal()
        return float(2 * self.count - len(self.penalty) + spared)

    def predict(self, marks: Marks) -> Array:
        """Camera coordinates (n, 2) where circles are to be seen."""
        return self.refinement.apply(marks.chain(self.tcp))

    def errors_mm(self, marks: Marks) -> Array:
        """Predicted minus seen (n, 2), millimetres on the table in world axes."""
        return marks.on_table_mm(self.predict(marks)) - marks.on_table_mm(marks.seen)


def fit(
    family: Family,
    marks: Marks,
    frame: Frame,
    start: Fit | None = None,
    weights: Array | None = None,
) -> Fit:
    """Gauss-Newton on the errors in millimetres, weighted by `weights` (n,); tcp has its prior.

    `start` spares steps. Families with a kernel first take an affine fit, choose how smooth they
    are from what it leaves, and are then linear too.
    """
    smooth = None
    if family.kernel != "none":
        plain = fit(_plain(family), marks, frame, weights=weights)
        smooth = _smoother(family.kernel, plain, marks, frame, start)
        start = plain
    parameters = _Parameters(family, frame, smooth)
    values = parameters.values(start)
    tcp = start.tcp if start is not None else np.zeros(2)
    scale = np.ones(len(marks)) if weights is None else np.sqrt(weights)
    for _ in range(STEPS):
        A, r = _linearise(parameters, values, tcp, marks, scale)
        penalty, pull = parameters.penalty(values, tcp)
        normal = A.T @ A + np.diag(penalty)
        step = np.linalg.solve(normal, -(A.T @ r + pull))
        values, tcp = values + step[:-2], tcp + 1e-3 * step[-2:]
        if np.abs(step).max() < NEGLIGIBLE_STEP:
            break
    return Fit(parameters.refinement(values), tcp, normal, penalty, len(marks), smooth)


def held_out_fits(
    family: Family, marks: Marks, frame: Frame, found: Fit, fold: Array
) -> Iterator[tuple[int, Fit]]:
    """For every fold, numbered by fold (n,), the fit of all other marks; `found` is that of all.

    Without a kernel one Gauss-Newton step from `found` does it: the derivatives of the marks that
    stay are those of `found`, in which the problem is as good as linear.
    """
    numbers = np.unique(fold).tolist()
    if family.kernel != "none":
        yield from ((k, fit(family, marks[fold != k], frame, start=found)) for k in numbers)
        return
    parameters = _Parameters(family, frame, None)
    values = parameters.values(found)
    A, r = design(family, marks, frame, found)
    penalty, pull = parameters.penalty(values, found.tcp)
    for number in numbers:
        kept = np.repeat(fold != number, 2)
        normal = A[kept].T @ A[kept] + np.diag(penalty)
        step = np.linalg.solve(normal, -(A[kept].T @ r[kept] + pull))
        refinement, tcp = parameters.refinement(values + step[:-2]), found.tcp + 1e-3 * step[-2:]
        yield number, Fit(refinement, tcp, normal, penalty, int(kept.sum()) // 2)


def design(family: Family, marks: Marks, frame: Frame, found: Fit) -> tuple[Array, Array]:
    """Derivatives (2n, p + 2) and errors (2n,), millimetres on the table, of the marks about a fit:
    by the family's values, and last by the pen's offset in mm."""
    parameters = _Parameters(family, frame, None)
    values = parameters.values(found)
    return _linearise(parameters, values, found.tcp, marks, np.ones(len(marks)))


def condition(family: Family, marks: Marks, frame: Frame) -> float:
    """Condition number of the family's columns over the marks, each scaled to the length 1.

    A family that can vanish at every circle without being zero has a huge one: held-out errors
    cannot tell, for what is left out lies where it vanishes too.
    """
    start = Refinement(family.name, frame.centre, frame.scale)
    free = replace(family, monomials=0) if np.isfinite(family.field_mm) else family
    columns = _Parameters(free, frame, None).basis(start, start.scaled(marks.chain(np.zeros(2))))
    columns = columns.reshape(2 * len(marks), -1)
    if columns.shape[1] == 0 or family.known:
        return 1.0  # nothing to determine, or determined before
    lengths = np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
    singular = np.linalg.svd(columns / lengths, compute_uv=False)
    short = len(singular) < columns.shape[1]
    return float("inf") if short else float(singular[0] / max(singular[-1], 1e-12))


def _plain(family: Family) -> Family:
    return replace(family, name="affine", kernel="none")


def _smoother(kernel: str, plain: Fit, marks: Marks, frame: Frame, start: Fit | None) -> Smoother:
    u = plain.refinement.scaled(marks.chain(plain.tcp))
    left = (marks.seen - plain.predict(marks)) / frame.scale
    return smoother(kernel, u, left, None if start is None else start.smooth)


@dataclass(frozen=True, eq=False)
class _Parameters:
    """The numbers that a family leaves free: its moves of H, its monomials' coefficients and its
    kernel's, both as (m, 2) read row by row."""

    family: Family
    frame: Frame
    smooth: Smoother | None

    def values(self, start: Fit | None) -> Array:
        """Those of a fit before, as far as it goes; or of the identity."""
        of_H, count = self.family.entries.shape[1], 2 * self.family.monomials
        values = np.zeros(of_H + count + self._of_kernel)
        if start is not None:
            moved = (start.refinement.H - np.eye(3)).reshape(9)[:8]
            values[:of_H] = np.linalg.lstsq(self.family.entries, moved, rcond=None)[0]
            if len(start.refinement.polynomial) == self.family.monomials:
                values[of_H : of_H + count] = start.refinement.polynomial.reshape(-1)
        return values

    @property
    def _of_kernel(self) -> int:
        return 0 if self.smooth is None else 2 * self.smooth.weights.shape[1]

    def refinement(self, values: Array) -> Refinement:
        of_H, count = self.family.entries.shape[1], 2 * self.family.monomials
        H = np.eye(3) + np.append(self.family.entries @ values[:of_H], 0.0).reshape(3, 3)
        polynomial = values[of_H : of_H + count].reshape(-1, 2)
        plain = (self.family.name, self.frame.centre, self.frame.scale, H, polynomial)
        if self.smooth is None:
            return Refinement(*plain)
        weights = self.smooth.weights @ values[of_H + count :].reshape(-1, 2)
        return Refinement(
            *plain, self.smooth.kernel, self.smooth.length, self.smooth.nodes, weights
        )

    def basis(self, at: Refinement, u: Array) -> Array:
        """Derivatives (n, 2, p) of the map, in scaled coordinates, by the values."""
        by_H = homography_jacobian(at.H, u)[1] @ self.family.entries
        columns = monomials(u, self.family.monomials)
        if self.smooth is not None:
            smooth = self.smooth
            phi = kernel_values(smooth.kernel, smooth.length, u, smooth.nodes)
            columns = np.concatenate([columns, phi @ smooth.weights], axis=1)
        both = columns[:, None, :, None] * np.eye(2)[:, None, :]
        return np.concatenate([by_H, both.reshape(len(u), 2, -1)], axis=2)

    def penalty(self, values: Array, tcp: Array) -> tuple[Array, Array]:
        """Diagonal (p + 2,) and gradient of what is known beforehand, in square millimetres."""
        diagonal = np.zeros(len(values) + 2)
        if self.smooth is not None:
            diagonal[-2 - self._of_kernel : -2] = self.smooth.ridge * self.frame.mm**2
        of_H, count = self.family.entries.shape[1], 2 * self.family.monomials
        diagonal[of_H : of_H + count] = (MARK_SIGMA_MM * self.frame.mm / self.family.field_mm) ** 2
        if self.family.known:
            diagonal[: self.family.entries.shape[1]] = MARK_SIGMA_MM**2
        diagonal[-2:] = (MARK_SIGMA_MM / TCP_PRIOR_MM) ** 2
        return diagonal, diagonal * np.append(values, 1e3 * tcp)


def _linearise(
    parameters: _Parameters, values: Array, tcp: Array, marks: Marks, scale: Array
) -> tuple[Array, Array]:
    """Design (2n, p + 2) and errors (2n,) in mm, tcp being in mm too."""
    refinement = parameters.refinement(values)
    chain = marks.chain(tcp)
    u = refinement.scaled(chain)
    by_values = refinement.scale * parameters.basis(refinement, u)
    by_place = homography_slopes(marks.table, marks.stand(tcp)) @ marks.turn
    by_tcp = 1e-3 * refinement.slopes(u) @ by_place
    mm = marks.mm * scale[:, None, None]
    A = mm @ np.concatenate([by_values, by_tcp], axis=2)
    r = mm @ (refinement.apply(chain) - marks.seen)[..., None]
    return A.reshape(2 * len(marks), -1), r.reshape(-1)
