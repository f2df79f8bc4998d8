"""Routes: what cannot be reached straight is reached another way, and only over allowed lines."""

from __future__ import annotations

import numpy as np
import pytest

from cellctl.config import parse_config
from cellctl.drivers.base import Path
from cellctl.motion import guard_of
from cellctl.procedures import routing
from tests import cells
from tests.postures import free_pen_at


@pytest.fixture(scope="module")
def guard():
    """A post stands in the middle of the table."""
    document = cells.document()
    document["workspace"]["keep_outs"] = [
        {"name": "post", "min_m": [-0.03, -0.48, 0.0], "max_m": [0.03, -0.42, 0.2]}
    ]
    return guard_of(parse_config(document, "test"))


@pytest.fixture(scope="module")
def sides(guard):
    left = free_pen_at(guard, -0.3, -0.4, 0.15)
    return left, free_pen_at(guard, 0.3, -0.4, 0.15, left)


def test_a_way_round_is_found_and_is_allowed(guard, sides):
    left, right = sides
    assert not guard.allows(left, Path(right[None]))
    path = routing.connect(guard, left, right)
    assert path is not None
    assert np.array_equal(path.waypoints[-1], right)
    guard.check(left, path)


def test_the_same_way_every_time(guard, sides):
    one, two = (routing.connect(guard, *sides) for _ in range(2))
    assert one is not None
    assert two is not None
    assert np.array_equal(one.waypoints, two.waypoints)


def test_no_way_into_an_obstacle(guard, sides):
    inside = sides[0].copy()
    inside[1] += 1.0
    assert not guard.free(inside[None])[0]
    assert routing.connect(guard, sides[0], inside) is None


def test_roadmap_paths_are_allowed_and_reach_their_goals(guard, sides):
    rng = np.random.default_rng(2)
    nodes = np.vstack([side + rng.uniform(-0.3, 0.3, (12, 6)) for side in sides])
    road = routing.Roadmap(guard, sides[0], nodes)
    free = {i for i in range(len(nodes)) if guard.free(nodes[i][None])[0]}
    assert set(road.index) <= free
    assert len(road.index) >= 5
    for i, place in road.index.items():
        path = road.path(sides[0], place)
        guard.check(sides[0], path)
        assert np.array_equal(path.waypoints[-1], nodes[i])


def test_a_bridge_leads_to_a_cluster_out_of_reach(guard, sides):
    rng = np.random.default_rng(2)
    left, right = (side + rng.uniform(-0.1, 0.1, (5, 6)) for side in sides)
    road = routing.Roadmap(guard, sides[0], np.vstack([left, right]))
    assert not road.index.keys() & set(range(5, 10))
    assert road.bridge()
    beyond = road.index.keys() & set(range(5, 10))
    assert beyond
    guard.check(sides[0], road.path(sides[0], road.index[min(beyond)]))


def test_nearest_first_is_greedy_and_complete():
    goals = np.linspace(0.0, 1.0, 5)[:, None].repeat(6, axis=1)
    assert routing.nearest_first(np.full(6, 0.6), goals) == [2, 1, 0, 3, 4]
