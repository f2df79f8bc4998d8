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
NEIGHBOURS = 5
CLUSTER_RAD = 0.8
"""Postures nearer than this are likely to be joined by a free line."""


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
    """Postures `nodes` (n, 6) joined to `root` (6,) by free joint lines, as a tree.

    Grown nearest node first (Prim), so that neighbours on the tree are near in joint space.
    `index` maps a reached node's number to its place on the tree. Once the node number `until` is
    reached it grows no further.
    """

    def __init__(
        self, guard: Guard, root: Array, nodes: Array, *, until: int | None = None
    ) -> None:
        self._until = until
        self.guard, self.tree, self.nodes = guard, Tree(root), nodes
        self.index: dict[int, int] = {}
        self._tried: list[set[int]] = [set() for _ in nodes]
        self._grow()

    def add(self, nodes: Array) -> None:
        """More postures (m, 6), numbered on from those that there are."""
        self.nodes = np.vstack([self.nodes, nodes])
        self._tried += [set() for _ in nodes]
        self._grow()

    def path(self, start: Array, b: int) -> Path:
        """From the posture `start`, which stands at the tree's root, to tree node `b`."""
        goal = self.tree.nodes[b]
        if self.guard.allows(start, Path(goal[None])):
            return Path(goal[None])
        down = self.tree.branch(b)[::-1]
        corners = np.array([start, *(self.tree.nodes[i] for i in down[1:])])
        return Path(shortened(self.guard, corners, seed=b)[1:])

    def bridge(self) -> bool:
        """Search a path to the thickest cluster of nodes that was not reached, and grow on there.

        False when there is none left, or none was found.
        """
        left = [i for i in range(len(self.nodes)) if i not in self.index]
        if not left:
            return False
        rest = self.nodes[left]
        gaps = np.abs(rest[:, None] - rest[None]).max(axis=2)
        goal = rest[int(np.argmax((gaps < CLUSTER_RAD).sum(axis=1)))]
        parent = int(self.tree.nearest(goal)[0])
        path = connect(self.guard, self.tree.nodes[parent], goal, seed=len(left))
        if path is None:
            return False
        for corner in path.waypoints:
            parent = self.tree.add(corner, parent)
        self._grow()
        return True

    def _grow(self) -> None:
        left = [i for i in range(len(self.nodes)) if i not in self.index]
        gap = {i: self._gap(self.nodes[i]) for i in left}
        while gap and self._until not in self.index:
            i = min(gap, key=lambda k: (gap[k], k))
            if not np.isfinite(gap[i]):
                return
            parent = self._parent(i)
            if parent is None:
                gap[i] = np.inf
                continue
            self.index[i] = self.tree.add(self.nodes[i], parent)
            del gap[i]
            for k, before in gap.items():
                reach = float(np.abs(self.nodes[k] - self.nodes[i]).max())
                if np.isfinite(before) or reach < CLUSTER_RAD:
                    gap[k] = min(before, reach)

    def _gap(self, node: Array) -> float:
        return float(np.abs(np.array(self.tree.nodes) - node).max(axis=1).min())

    def _parent(self, i: int) -> int | None:
        """The nearest tree node with a free line to node `i`; those tried are passed over."""
        for parent in map(int, self.tree.nearest(self.nodes[i], NEIGHBOURS)):
            if parent in self._tried[i]:
                continue
            self._tried[i].add(parent)
            if self.guard.allows(self.tree.nodes[parent], Path(self.nodes[i][None])):
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
