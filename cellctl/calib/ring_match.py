"""Which found ring is which expected one: jointly, for neighbours may be nearer than the search
reaches, and what is off is mostly off alike.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from cellctl.geometry import Array, Mask

LIKE = 0.15
"""Rings that follow the common shift differ from it by about that share of the search radius."""
ALONE = 0.5
"""The same for fewer than ENOUGH rings, whose common shift is hardly known."""
ENOUGH = 4
OTHER_RADIUS, UNFINISHED = 3.0, 1.0
"""Costs of a ring with another radius (for half or one and a half of it) and of one that is not
whole, where being off by twice the usual costs 1."""
LINEAR = 0.5
"""How far turn and stretch may move the outermost ring, in search radii, one sigma."""
FAR = 4.0
"""Cost of being off beyond which a ring is another one."""
NONE = 4.5
"""Cost of an expected ring without a ring: neighbours do not lend theirs to each other."""
SURE = 0.5
"""Looks of a ring that is whole, and within 8 % of its radius."""
ROUNDS = 4
FORBIDDEN = 1e6


def match_rings(
    wanted: Array,
    wanted_radii: Array,
    found: Array,
    found_radii: Array,
    whole: Mask,
    search_m: float,
) -> Array:
    """(n,) for each of the rings expected at `wanted` (n, 2) with `wanted_radii` (n,), metres, the
    number of its ring among those `found` (m, 2), or -1.

    First the shift that brings most rings home, then a smooth field about it (shift, turn and
    stretch, held weakly), then the cheapest assignment of one to one. What is off in the tool is
    off otherwise wherever the tool is turned: whole rings that are left go to who is left, where
    that is unambiguous.
    """
    if not len(found):
        return np.full(len(wanted), -1)
    gaps = found[None] - wanted[:, None]
    relative = found_radii[None] / wanted_radii[:, None]
    near = (np.linalg.norm(gaps, axis=-1) <= search_m) & (relative > 0.45) & (relative < 1.55)
    looks = OTHER_RADIUS * np.abs(relative - 1.0) / 0.5 + UNFINISHED * ~whole[None]
    like = max(LIKE * search_m, 1e-6)
    field = np.broadcast_to(_common_shift(gaps, near, looks, like), wanted.shape)
    chosen = _assign(gaps, field, near, looks, like)
    for _ in range(ROUNDS):
        sure = chosen >= 0
        if sure.sum() < ENOUGH:
            like = ALONE * search_m
            field = np.zeros_like(wanted) if sure.sum() < 2 else field
        else:
            home = gaps[np.flatnonzero(sure), chosen[sure]]
            field = _smooth_field(wanted, wanted[sure], home, like, search_m)
        chosen = _assign(gaps, field, near, looks, like)
    return _with_left_over(chosen, near & (looks < SURE))


def _common_shift(gaps: Array, near: Mask, looks: Array, like: float) -> Array:
    """(2,): the shift that brings most rings home, good-looking ones first; of equals the
    smallest."""
    pairs = np.argwhere(near)
    if not len(pairs):
        return np.zeros(2)
    shifts, worth = gaps[near], np.exp(-looks[near])
    best, shift = -1.0, np.zeros(2)
    for candidate in shifts[np.argsort(np.linalg.norm(shifts, axis=1))]:
        home = np.square((shifts - candidate) / like).sum(axis=1)
        support = worth * np.exp(-0.5 * home)
        score = min(_best_of_each(support, pairs[:, 0]), _best_of_each(support, pairs[:, 1]))
        if score > best * 1.001:
            best, shift = score, candidate
    return shift


def _best_of_each(support: Array, owners: Array) -> float:
    """The sum over owners of each one's largest support: no ring counts twice."""
    best = np.zeros(owners.max() + 1)
    np.maximum.at(best, owners, support)
    return float(best.sum())


def _smooth_field(places: Array, at: Array, shifts: Array, like: float, search_m: float) -> Array:
    """Shifts (n, 2) at `places`, smooth over the plane, from shifts (m, 2) at places `at`;
    strays count little."""
    middle = places.mean(axis=0)
    extent = max(float(np.abs(places - middle).max()), 1e-9)
    design = np.column_stack([np.ones(len(at)), (at - middle) / extent])
    prior = np.diag([0.0, 1.0, 1.0]) / (LINEAR * search_m / like) ** 2
    weights = np.ones(len(at))
    fit = np.zeros((3, 2))
    fit[0] = np.median(shifts, axis=0)
    for _ in range(5):
        off = np.square((shifts - design @ fit) / like).sum(axis=1)
        weights = 1.0 / (1.0 + off)
        normal = (design.T * weights) @ design + prior
        fit = np.linalg.solve(normal, (design.T * weights) @ shifts)
    return np.column_stack([np.ones(len(places)), (places - middle) / extent]) @ fit


def _with_left_over(chosen: Array, sure: Mask) -> Array:
    """`chosen` (n,), and pairs of `sure` (n, m) of which neither has another partner left."""
    free = np.full(sure.shape[1], True)
    free[chosen[chosen >= 0]] = False
    left = sure & free[None] & (chosen < 0)[:, None]
    only = left & (left.sum(axis=1) == 1)[:, None] & (left.sum(axis=0) == 1)[None]
    return np.where(only.any(axis=1), only.argmax(axis=1), chosen)


def _assign(gaps: Array, field: Array, near: Mask, looks: Array, like: float) -> Array:
    """(n,): for each expected ring its own, or -1, at the least cost in all."""
    off = np.square((gaps - field[:, None]) / (2.0 * like)).sum(axis=-1)
    cost = np.where(near & (off < FAR), looks + off, FORBIDDEN)
    nothing = np.full((len(gaps), len(gaps)), NONE)
    _, columns = linear_sum_assignment(np.hstack([cost, nothing]))
    return np.where(columns < gaps.shape[1], columns, -1)
