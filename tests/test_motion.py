"""The guard: nothing that it should refuse passes, and it says what is wrong and where."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cellctl.config import parse_config
from cellctl.drivers.base import Path
from cellctl.errors import MotionRefused
from cellctl.hulls import box_body, capsule_body, link_bodies
from cellctl.motion import MAX_STEP_M, guard_of
from tests import cells
from tests.postures import free_pen_at, pen_at


def refused(guard, start, *waypoints):
    with pytest.raises(MotionRefused) as caught:
        guard.check(start, Path(np.array(waypoints)))
    return caught.value.message


@pytest.fixture(scope="module")
def guard():
    return guard_of(cells.config())


@pytest.fixture(scope="module")
def start(guard):
    return free_pen_at(guard, 0.0, -0.45, 0.2)


def test_a_free_path_passes(guard, start):
    guard.check(start, Path(start[None] + 0.02))


def test_pen_into_the_table_is_refused_and_named(guard, start):
    low = pen_at(guard, 0.0, -0.45, -0.02, start)[0]
    assert "pen comes too near to the table" in refused(guard, start, low)


def test_the_whole_path_counts_not_only_its_end(guard, start):
    low = pen_at(guard, 0.0, -0.45, -0.02, start)[0]
    message = refused(guard, start, low, start)
    assert "refused at" in message
    assert "table" in message


def test_first_waypoint_is_checked_from_the_measured_joints(guard, start):
    low = pen_at(guard, 0.0, -0.45, -0.02, start)[0]
    assert "stands where it must not" in refused(guard, low, start)


def test_a_cautious_guard_keeps_further_away(guard, start):
    posture = start
    for height in np.arange(0.2, 0.0, -0.003):
        lower = pen_at(guard, 0.0, -0.45, height, posture)[0]
        if not guard.free(lower)[0]:
            break
        posture = lower
    strict = guard.cautious(start)
    assert strict.free(start)[0]
    assert not strict.free(posture)[0]
    assert guard.cautious(start, posture) is guard


def test_keep_out_is_named():
    document = cells.document()
    document["workspace"]["keep_outs"] = [
        {"name": "vice", "min_m": [-0.05, -0.5, 0.0], "max_m": [0.05, -0.4, 0.3]}
    ]
    guard = guard_of(parse_config(document, "test"))
    left = free_pen_at(guard, -0.3, -0.45, 0.2)
    right = free_pen_at(guard, 0.3, -0.45, 0.2, left)
    assert "keep-out 'vice'" in refused(guard, left, right)


@pytest.fixture(scope="module")
def edged():
    """A guard whose table ends at x = 0.2 m."""
    document = cells.document()
    document["table"]["top"] = {"min_m": [-0.9, -0.9], "max_m": [0.2, -0.1]}
    document["workspace"]["box"]["min_m"][2] = -0.8
    return guard_of(parse_config(document, "test"))


def test_beside_the_table_the_arm_may_reach_below_it(guard, edged, start):
    beside = free_pen_at(edged, 0.6, -0.45, -0.1, start)
    assert "comes too near to the table" in refused(guard, start, beside)
    over = free_pen_at(edged, 0.6, -0.45, 0.2, beside)
    edged.check(beside, Path(over[None]))


def test_a_table_with_edges_is_solid(edged, start):
    low = pen_at(edged, 0.0, -0.45, -0.1, start)[0]
    assert "comes too near to the table" in refused(edged, start, low)


def test_the_side_of_a_table_is_a_clearance_away(edged):
    """Spheres below the table's height: as near to its edge as their reach allows."""
    centres = np.array([[[x, -0.45, -0.3] for x in (0.1, 0.24, 0.26)]])
    assert edged.scene.near_table(centres, np.full(3, 0.05)).tolist() == [[True, True, False]]
    above = np.array([[[0.23, -0.45, z] for z in (0.03, 0.05)]])
    assert edged.scene.near_table(above, np.full(2, 0.05)).tolist() == [[True, False]]


@given(st.lists(st.floats(-2.0, 2.0), min_size=3, max_size=3), st.floats(0.01, 0.5))
def test_a_table_without_edges_is_one_of_which_nobody_comes_to_the_edge(
    guard, edged, centre, reach
):
    endless, ends = guard.scene, edged.scene
    wide = replace(ends, table_top=np.array([[-10.0, -10.0], [10.0, 10.0]]))
    sphere, radius = np.array([[centre]]), np.array([reach])
    assert endless.near_table(sphere, radius) == wide.near_table(sphere, radius)


def test_camera_is_not_touched(guard, start):
    high = pen_at(guard, 0.0, -0.44, 0.55, start)[0]
    assert "too near to the camera" in refused(guard, start, high)


def test_joint_limits_have_a_margin(guard, start):
    over = start.copy()
    over[5] = np.radians(358.0)
    message = refused(guard, start, over)
    assert "limit" in message or "meet" in message


def test_self_collision_is_refused(guard):
    wings_into_forearm = np.radians([[-131.0, -17.0, 24.0, 55.0, -143.0, -89.0]])
    reasons = [
        f"{who} {rule.what}"
        for rule in guard.rules(wings_into_forearm)
        for who, broken in zip(rule.who, rule.broken[0], strict=True)
        if broken
    ]
    assert "link 3 and marker board meet" in reasons


@pytest.mark.parametrize("waypoints", [np.zeros((0, 5)), np.full((1, 6), np.nan), np.zeros(6)])
def test_nonsense_paths_are_refused(guard, start, waypoints):
    with pytest.raises(MotionRefused, match="finite joint angles"):
        guard.check(start, Path(waypoints))


def test_sampling_leaves_no_gap(guard, start):
    path = Path(np.array([start + 0.5]))
    centres, _ = guard.spheres(guard.sample(start, path))
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=2)
    assert steps.max() <= MAX_STEP_M * 1.05
    assert steps.max() < guard.clearance / 2


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6))
def test_check_agrees_with_its_states(guard, start, joints):
    path = Path(np.array([joints]))
    assert guard.allows(start, path) == guard.free(guard.sample(start, path)).all()
    if not guard.allows(start, path):
        refused(guard, start, joints)


def test_hulls_cover_their_shapes(guard):
    rng = np.random.default_rng(0)
    for link, body in zip(guard.arm.links, link_bodies(guard.arm), strict=True):
        a, b = np.array(link.start), np.array(link.end)
        on_axis = a + (b - a) * rng.uniform(0, 1, (500, 1))
        direction = rng.normal(size=(500, 3))
        surface = on_axis + link.radius * direction / np.linalg.norm(direction, axis=1)[:, None]
        assert covered(capsule_body("", link), surface).all()
        assert body.frame == link.frame
    box = box_body("box", 6, np.array([0.1, 0.2, 0.3]), np.array([0.3, 0.2, 0.03]))
    inside = np.array([0.1, 0.2, 0.3]) + rng.uniform(-0.5, 0.5, (2000, 3)) * (0.3, 0.2, 0.03)
    assert covered(box, inside).all()


def covered(body, points):
    distance = np.linalg.norm(points[:, None] - body.points, axis=2)
    return (distance <= body.radii + 1e-12).any(axis=1)
