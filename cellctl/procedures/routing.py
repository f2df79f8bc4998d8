"""Joint paths between views that the guard allows, and the order in which to visit them.

A straight joint line where that is free; else RRT-Connect (Kuffner and LaValle 2000) with
shortcuts. Deterministic: the same start, goal and scene give the same path.
"""

from __future__ import annotations

import numpy as np

from cellctl.arms import JOINTS
from cellctl.drivers.base import Path
from cellctl.geometry import Array
from cellctl.motion import Guard

STEP_RAD = 0.25
MARGIN_RAD = 1.2
MAX_TRIES = 200
SHORTCUTS = 30


def connect(guard: Guard, start: Array, goal: Array, seed: int = 0) -> Path | None:
    """An allowed path from `start` to `goal` (6,), or None when none was found."""
    direct = Path(goal[None])
    if guard.allows(start, direct):
        return direct
    if not guard.free(np.vstack([start, goal])).all():
        return None
    rng = np.random.default_rng(seed)
    corners = _rrt_connect(guard, start, goal, rng)
    return None if corners is None else Path(_shortened(guard, corners, rng)[1:])


def nearest_first(
    guard: Guard, start: Array, goals: Array, limit: int | None = None
) -> list[tuple[int, Path]]:
    """Visit goals (n, 6), nearest first: (index, path from the one before) in order.

    Goals that cannot be reached from where the arm then stands are left out.
    """
    left, here = set(range(len(goals))), start
    route: list[tuple[int, Path]] = []
    while left and (limit is None or len(route) < limit):
        order = sorted(left, key=lambda i: (float(np.abs(goals[i] - here).max()), i))
        found = _first_reachable(guard, here, goals, order)
        if found is None:
            break
        route.append(found)
        left.discard(found[0])
        here = goals[found[0]]
    return route


def _first_reachable(
    guard: Guard, here: Array, goals: Array, order: list[int]
) -> tuple[int, Path] | None:
    """Straight lines are tried for all before a path is searched for any."""
    for i in order:
        if guard.allows(here, Path(goals[i][None])):
            return i, Path(goals[i][None])
    for i in order[:5]:
        path = connect(guard, here, goals[i], seed=i)
        if path is not None:
            return i, path
    return None


class _Tree:
    def __init__(self, root: Array) -> None:
        self.nodes, self.parents = [root], [-1]

    def nearest(self, point: Array) -> int:
        return int(np.argmin(np.abs(np.array(self.nodes) - point).max(axis=1)))

    def add(self, point: Array, parent: int) -> int:
        self.nodes.append(point)
        self.parents.append(parent)
        return len(self.nodes) - 1

    def branch(self, index: int) -> list[Array]:
        """From the node to the root."""
        points = []
        while index >= 0:
            points.append(self.nodes[index])
            index = self.parents[index]
        return points


def _rrt_connect(guard: Guard, start: Array, goal: Array, rng: np.random.Generator) -> Array | None:
    near, far = _Tree(start), _Tree(goal)
    low = np.maximum(np.minimum(start, goal) - MARGIN_RAD, guard.arm.limits[:, 0])
    high = np.minimum(np.maximum(start, goal) + MARGIN_RAD, guard.arm.limits[:, 1])
    flipped = False
    for _ in range(MAX_TRIES):
        sample = rng.uniform(low, high, JOINTS)
        a = _extend(guard, near, near.nearest(sample), sample, steps=1)
        b = _extend(guard, far, far.nearest(near.nodes[a]), near.nodes[a], steps=20)
        if np.array_equal(far.nodes[b], near.nodes[a]):
            points = near.branch(a)[::-1] + far.branch(b)[1:]
            return np.array(points[::-1] if flipped else points)
        near, far, flipped = far, near, not flipped
    return None


def _extend(guard: Guard, tree: _Tree, index: int, target: Array, steps: int) -> int:
    """Grow from node `index` towards `target` while that is free; the last node's index."""
    for _ in range(steps):
        here = tree.nodes[index]
        reach = np.abs(target - here).max()
        new = target if reach <= STEP_RAD else here + (target - here) * (STEP_RAD / reach)
        if not guard.allows(here, Path(new[None])):
            return index
        index = tree.add(new, index)
        if new is target:
            return index
    return index


def _shortened(guard: Guard, corners: Array, rng: np.random.Generator) -> Array:
    points = list(corners)
    for _ in range(SHORTCUTS):
        if len(points) < 3:
            break
        i = int(rng.integers(0, len(points) - 2))
        j = int(rng.integers(i + 2, len(points)))
        if guard.allows(points[i], Path(points[j][None])):
            del points[i + 1 : j]
    return np.array(points)
