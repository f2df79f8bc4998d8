"""How far light will land from where the pen stands, why, and what would help most.

The error at a place is linear in what is off in the unknowns, d = J dx, and dx is a sum over the
noises of the groups of observations (see `noise`): so the variance over the table splits exactly
into what each group costs. With other data the normal matrix changes by what those data tell,
which is known before they are taken: industrial measuring design, W. Foerstner and B. Wrobel,
Photogrammetric Computer Vision, 2016, section 4.6.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cellctl.calib.joint.pictures import light_on_table, pen
from cellctl.calib.joint.result import JointResult
from cellctl.calib.schur import inverse_of
from cellctl.geometry import Array

SOURCES = {
    "touch": "plane",
    "markers": "projector",
    "lit": "projector",
    "draw": "drawing",
    "field": "arm",
    "robot": "arm",
    "look": "arm",
    "bend": "projector",
    "level": "plane",
    "prior": "prior",
}
"""What the noise of a group of observations is called in a budget. Views have their own names,
and the robot's noise in them counts with them; "arm" is what the smooth displacements leave."""
TCP = "tcp"
HOPELESS_MM = 1e3
"""A predicted error beyond this says that the data do not determine the map."""


@dataclass(frozen=True, eq=False)
class ErrorMap:
    """At places (n, 2) of the world, metres: covariances (n, 2, 2), mm^2, of where light lands
    less where the pen stands, in all and by source. The sources add up."""

    points: Array
    covariance: Array
    sources: Mapping[str, Array]

    @property
    def sigma_mm(self) -> Array:
        """Root mean square distance (n,) to expect at each place, mm."""
        return np.sqrt(np.trace(self.covariance, axis1=1, axis2=2))

    @property
    def rms_mm(self) -> float:
        """Over the places."""
        return float(np.sqrt(np.square(self.sigma_mm).mean()))

    @property
    def budget_mm(self) -> dict[str, float]:
        """What each source costs, root mean square over the places; their squares add up."""
        return {name: _rms(part) for name, part in self.sources.items()}


@dataclass(frozen=True, eq=False)
class Step:
    """One point of a curve: the predicted error with the first `count` of a kind of data."""

    count: int
    rms_mm: float


def error_map(result: JointResult, points: Array) -> ErrorMap:
    """The error to expect at world places (n, 2), metres."""
    J, covariance = map_slopes(result, points), result.covariance
    parts = dict[str, Array]()
    for name, information in _by_source(result).items():
        parts[name] = _spread(J, covariance @ information @ covariance)
    if "tcp" in result.layout and "drawing" in parts:
        parts = _with_tcp(result, J, parts)
    return ErrorMap(np.asarray(points), _spread(J, covariance), parts)


def map_slopes(result: JointResult, points: Array) -> Array:
    """Derivatives (n, 2, g), in mm of the world's x and y, by the unknowns of how far light sent
    for world places (n, 2) lands from where the pen stands."""
    state, problem = result.state, result.problem
    xy = np.asarray(points, dtype=float)[:, :2]
    drawn = pen(state, problem.look, problem.field, xy, np.broadcast_to(np.eye(2), (len(xy), 2, 2)))
    pixels = result.calibration.project(xy)
    lit = light_on_table(state, problem.look, problem.bend, pixels)
    J = np.zeros((len(xy), 2, problem.layout.count))
    for sign, picture in ((-1.0, drawn), (1.0, lit)):
        for name, slopes in picture.slopes.items():
            if name in problem.layout:
                J[..., problem.layout.slices[name]] += sign * slopes
    return 1e3 * np.linalg.inv(drawn.slopes["place"]) @ J


def what_next(result: JointResult, points: Array) -> dict[str, float]:
    """Predicted error over world places (n, 2), mm rms, if there were twice as much of one kind
    of data, placed alike; by the kind, least first."""
    J, S = map_slopes(result, points), _normal(result)
    gains = {
        kind: _rms(_spread(J, inverse_of(S + units.sum(axis=0))))
        for kind, units in data(result).items()
    }
    return dict(sorted(gains.items(), key=lambda item: item[1]))


def curve(
    result: JointResult, points: Array, kind: str, counts: Sequence[int] | None = None
) -> list[Step]:
    """Predicted error over world places (n, 2) with the first `counts` of a kind of `data`, the
    noises being as they are. Infinite while those do not determine the map."""
    J, units = map_slopes(result, points), data(result)[kind]
    counts = counts or sorted({round(n) for n in np.geomspace(1, len(units), 12)})
    rest, sums = _normal(result) - units.sum(axis=0), np.cumsum(units, axis=0)
    steps = []
    for count in counts:
        S = rest + (sums[count - 1] if count else 0.0)
        found = _rms(_spread(J, inverse_of(S)))
        steps.append(Step(count, found if found < HOPELESS_MM else float("inf")))
    return steps


def data(result: JointResult) -> dict[str, Array]:
    """By kind of data, what each unit (a view, touch, lit point or circle) tells about the
    globals: (u, g, g). Views go by the name of their group, with the robot's word on them."""
    found = {}
    for group in result.problem.groups:
        units = result.information[group.name].copy()
        for name in ("turn", "shift"):
            units += result.information[name][group.views]
        found[group.name] = units
    kinds = {"touch": "touches", "markers": "markers", "lit": "lit boards", "draw": "circles"}
    for name, kind in kinds.items():
        if name in result.information:
            found[kind] = result.information[name]
    return found


def _by_source(result: JointResult) -> dict[str, Array]:
    found = {group.name: data(result)[group.name].sum(axis=0) for group in result.problem.groups}
    for name, source in SOURCES.items():
        if name in result.information:
            before = found.get(source, 0.0)
            found[source] = before + result.information[name].sum(axis=0)
    return found


def _with_tcp(result: JointResult, J: Array, parts: dict[str, Array]) -> dict[str, Array]:
    """Drawing costs less when the pen's offset is known; the rest is put down to the offset."""
    place = result.layout.slices["tcp"]
    S = _normal(result)
    known = S.copy()
    known[place, place] += np.diag(1e12 * np.maximum(S.diagonal()[place], 1.0))
    part = _spread(J, result.covariance) - _spread(J, inverse_of(known))
    return {**parts, "drawing": parts["drawing"] - part, TCP: part}


def _normal(result: JointResult) -> Array:
    """The Schur complement (g, g): what all data tell about the globals."""
    return np.asarray(sum(one.sum(axis=0) for one in result.information.values()))


def _spread(J: Array, covariance: Array) -> Array:
    return J @ covariance @ np.swapaxes(J, 1, 2)


def _rms(covariances: Array) -> float:
    return float(np.sqrt(max(np.trace(covariances, axis1=1, axis2=2).mean(), 0.0)))
