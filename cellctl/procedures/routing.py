"""Joint paths that the guard allows, and the order in which to visit postures.

A straight joint line where that is free; else along a tree of free lines (`Roadmap`) or, for a
single goal, RRT-Connect (Kuffner and LaValle 2000). Deterministic: the same start, goals and
scene give the same paths.
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
NEIGHBOURS = 4


class Tree:
    """Joint postures with parents; the root's parent is -1."""

    def __init__(self, root: Array) -> None:
        self.nodes, self.parents = [root], [-1]

    def nearest(self, point: Array, count: int = 1) -> Array:
        """Indices of the `count` nodes nearest to `point` by their largest joint difference."""
        distance = np.abs(np.array(self.nodes) - point).max(axis=1)
        return np.argsort(distance, kind="stable")[:count]

    def add(self, point: Array, parent: int) -> int:
        self.nodes.append(point)
        self.parents.append(parent)
        return len(self.nodes) - 1

    def branch(self, index: int) -> list[int]:
        """Indices from a node to the root."""
        indices = []
        while index >= 0:
            indices.append(index)
            index = self.parents[index]
        return indices


class Roadmap:
    """All of the postures `nodes` (n, 6) that free joint lines join to `root` (6,), as a tree.

    Grown nearest node first (Prim), so that neighbours on the tree are near in joint space.
    `index` maps a reached node's number to its place on the tree.
    """

    def __init__(self, guard: Guard, root: Array, nodes: Array) -> None:
        self.guard, self.tree = guard, Tree(root)
        self.index: dict[int, int] = {}
        self._grow(nodes)

    def path(self, start: Array, a: int, b: int) -> Path:
        """From the posture `start`, at tree node `a`, to tree node `b`."""
        goal = self.tree.nodes[b]
        if self.guard.allows(start, Path(goal[None])):
            return Path(goal[None])
        up, down = self.tree.branch(a), self.tree.branch(b)
        meet = next(i for i in up if i in set(down))
        walk = up[: up.index(meet) + 1] + down[: down.index(meet)][::-1]
        corners = [start, *(self.tree.nodes[i] for i in walk[1:])]
        return Path(shortened(self.guard, np.array(corners), seed=b)[1:])

    def _grow(self, nodes: Array) -> None:
        left = set(range(len(nodes)))
        gap = np.abs(nodes - self.tree.nodes[0]).max(axis=1)
        tried: dict[int, set[int]] = {i: set() for i in left}
        while left:
            i = min(left, key=lambda k: (gap[k], k))
            if not np.isfinite(gap[i]):
                return
            parent = self._parent(nodes[i], tried[i])
            if parent is None:
                gap[i] = np.inf
                continue
            self.index[i] = self.tree.add(nodes[i], parent)
            left.discard(i)
            reach = np.abs(nodes - nodes[i]).max(axis=1)
            gap = np.where(np.isinf(gap) & (reach > 1.0), np.inf, np.minimum(gap, reach))

    def _parent(self, node: Array, tried: set[int]) -> int | None:
        """The nearest tree node with a free line to `node`; those tried before are passed over."""
        for parent in map(int, self.tree.nearest(node, NEIGHBOURS)):
            if parent in tried:
                continue
            tried.add(parent)
            if self.guard.allows(self.tree.nodes[parent], Path(node[None])):
                return parent
        return None


def connect(guard: Guard, start: Array, goal: Array, seed: int = 0) -> Path | None:
    """An allowed path from `start` to `goal` (6,), or None when none was found."""
    direct = Path(goal[None])
    if guard.allows(start, direct):
        return direct
    if not guard.free(np.vstack([start, goal])).all():
        return None
    corners = _rrt_connect(guard, start, goal, np.random.default_rng(seed))
    return None if corners is None else Path(shortened(guard, corners, seed)[1:])


def nearest_first(start: Array, goals: Array) -> list[int]:
    """The order in which to visit goals (n, 6), always on to the nearest by joint difference."""
    left, here = list(range(len(goals))), start
    order: list[int] = []
    while left:
        i = min(left, key=lambda k: (float(np.abs(goals[k] - here).max()), k))
        order.append(i)
        left.remove(i)
        here = goals[i]
    return order


def shortened(guard: Guard, corners: Array, seed: int) -> Array:
    """The polyline `corners` (n, 6) with detours cut where a straight line is allowed."""
    rng = np.random.default_rng(seed)
    points = list(corners)
    for _ in range(SHORTCUTS):
        if len(points) < 3:
            break
        i = int(rng.integers(0, len(points) - 2))
        j = int(rng.integers(i + 2, len(points)))
        if guard.allows(points[i], Path(points[j][None])):
            del points[i + 1 : j]
    return np.array(points)


def _rrt_connect(guard: Guard, start: Array, goal: Array, rng: np.random.Generator) -> Array | None:
    near, far = Tree(start), Tree(goal)
    low = np.maximum(np.minimum(start, goal) - MARGIN_RAD, guard.arm.limits[:, 0])
    high = np.minimum(np.maximum(start, goal) + MARGIN_RAD, guard.arm.limits[:, 1])
    flipped = False
    for _ in range(MAX_TRIES):
        sample = rng.uniform(low, high, JOINTS)
        a = _extend(guard, near, int(near.nearest(sample)[0]), sample, steps=1)
        met = near.nodes[a]
        b = _extend(guard, far, int(far.nearest(met)[0]), met, steps=20)
        if np.array_equal(far.nodes[b], met):
            indices = [near.nodes[i] for i in near.branch(a)[::-1]]
            points = indices + [far.nodes[i] for i in far.branch(b)[1:]]
            return np.array(points[::-1] if flipped else points)
        near, far, flipped = far, near, not flipped
    return None


def _extend(guard: Guard, tree: Tree, index: int, target: Array, steps: int) -> int:
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
