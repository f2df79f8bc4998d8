"""Leading the pen: upright, along the normal, on one branch, and only where it may be down."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cellctl.calib.plane import Plane
from cellctl.config import parse_config
from cellctl.drivers.base import Stroke
from cellctl.errors import MotionRefused
from cellctl.motion import guard_of
from cellctl.procedures import pen, spots
from cellctl.sim.cell_config import cell_document
from cellctl.sim.presets import PRESETS
from cellctl.store.sheets import Spot

CONFIG = parse_config(cell_document(PRESETS["cr"], 0), "test")
GUARD = guard_of(CONFIG)
TILTED = Plane(np.array([0.0, -0.44, 0.0005]), np.array([0.002, -0.001, 1.0]) / np.sqrt(1 + 5e-6))
RIG = pen.pen_rig(CONFIG, GUARD, TILTED, TILTED.normal, np.zeros(6))
CENTRE = np.array([0.2, -0.5])
RADIUS = 0.01


def tips_of(joints):
    assert GUARD.pen is not None
    return GUARD.pen.tips(GUARD.arm.forward(joints))


@pytest.fixture(scope="module")
def circle():
    return pen.stroke(RIG, pen.circle(RIG, CENTRE, RADIUS), np.radians(30.0), 0.06)


def test_a_stroke_follows_its_circle(circle):
    tips = tips_of(circle.joints)
    over = tips[:, 2] - TILTED.height(tips[:, :2])
    down = over < -RIG.depth + 1e-5
    radii = np.linalg.norm(tips[down, :2] - CENTRE, axis=1)
    assert np.abs(radii - RADIUS).max() < 2e-5
    turned = np.unwrap(np.arctan2(*(tips[down, :2] - CENTRE).T[::-1]))
    assert turned[-1] - turned[0] == pytest.approx(2 * np.pi, abs=0.02)
    on_paper = np.linalg.norm(tips[over < 0.0, :2] - CENTRE, axis=1)
    assert np.abs(on_paper - RADIUS).max() < 2e-5
    assert over[[0, -1]] == pytest.approx(RIG.lift, abs=1e-6)
    assert np.linalg.norm(np.diff(tips, axis=0), axis=1).max() < 1.05e-3


def test_it_comes_down_along_the_normal(circle):
    tips = tips_of(circle.joints)
    way = tips[20] - tips[0]
    assert way / np.linalg.norm(way) == pytest.approx(-TILTED.normal, abs=1e-6)


def test_the_tool_stays_upright_and_turned(circle):
    flanges = GUARD.arm.forward(circle.joints)
    assert flanges[:, 2, 2] == pytest.approx(-1.0)
    posture = GUARD.arm.forward(RIG.posture)[:3, 0]
    turn = np.degrees(np.arctan2(flanges[0, 1, 0], flanges[0, 0, 0]))
    start = np.degrees(np.arctan2(posture[1], posture[0]))
    assert (turn - start + 180) % 360 - 180 == pytest.approx(30.0, abs=0.2)


def test_the_way_has_no_corner(circle):
    steps = np.diff(tips_of(circle.joints), axis=0)
    along = steps / np.linalg.norm(steps, axis=1)[:, None]
    assert (along[1:] * along[:-1]).sum(axis=1).min() > np.cos(np.radians(15.0))


def test_no_joint_jumps(circle):
    assert np.abs(np.diff(circle.joints, axis=0)).max() < 0.02


def refused(stroke, match, guard=GUARD):
    with pytest.raises(MotionRefused, match=match):
        guard.check_stroke(stroke)


def test_a_pen_pushed_in_too_far_is_refused():
    deep = replace(RIG, depth=CONFIG.bracket.pen.travel_m + 0.002)
    with pytest.raises(MotionRefused, match="further than its holder"):
        pen.stroke(deep, pen.circle(deep, CENTRE, RADIUS), 0.0, 0.06)


def test_beside_the_sheets_the_pen_stays_up(circle):
    document = cell_document(PRESETS["cr"], 0)
    document["sheets"] = [{"name": "far", "min_m": [-0.3, -0.6], "max_m": [0.0, -0.5]}]
    refused(circle, "beside the sheets", guard_of(parse_config(document, "test")))


def test_what_lies_between_far_points_cannot_be_checked(circle):
    refused(Stroke(circle.joints[::30], 0.06), "mm apart")


def test_a_stroke_that_is_none_is_refused(circle):
    refused(Stroke(np.zeros((0, 6)), 0.06), "is \\(n, 6\\)")
    refused(Stroke(np.full((3, 6), np.nan), 0.06), "finite")
    refused(Stroke(circle.joints, 0.0), "speed")


def test_outside_a_stroke_the_pen_keeps_clear(circle):
    low = circle.joints[len(circle.joints) // 2]
    assert not GUARD.free(low[None])[0]
    assert GUARD.draws(low[None])[0]


def test_a_pen_that_is_down_is_lifted_until_the_arm_is_free(circle):
    low = circle.joints[len(circle.joints) // 2]
    up = pen.lifted(GUARD, low, 0.05)
    assert up is not None
    GUARD.check_stroke(up)
    assert GUARD.free(up.joints[-1:])[0]
    assert tips_of(up.joints)[:, :2] == pytest.approx(
        np.tile(tips_of(low)[:2], (len(up.joints), 1))
    )
    assert pen.lifted(GUARD, up.joints[-1], 0.05) is None


@pytest.fixture(scope="module")
def planned():
    return spots.plan_spots(RIG, CONFIG, [], 60, RADIUS, 0)


def test_spots_fill_the_area_to_its_edges(planned):
    xy = np.array([spot.xy for spot in planned])
    low, high = spots.area(CONFIG)
    assert len(planned) == 60
    assert xy.min(axis=0) == pytest.approx(low, abs=1e-9)
    assert xy.max(axis=0) == pytest.approx(high, abs=1e-9)
    gaps = np.linalg.norm(xy[:, None] - xy, axis=2) + np.eye(len(xy))
    assert gaps.min() > 2 * RADIUS + spots.MARGIN_M
    assert len(np.unique(xy[:, 0].round(4))) > 30


def test_the_tool_is_turned_at_least_three_ways(planned):
    yaws = np.degrees([spot.yaw for spot in planned]).round()
    assert sum(np.count_nonzero(yaws == yaw) >= 5 for yaw in np.unique(yaws)) >= 3


def test_used_paper_is_left_alone(planned):
    used = [
        ("A", Spot(float(s.xy[0]), float(s.xy[1]), RADIUS, f"{i}"))
        for i, s in enumerate(planned[:40])
    ]
    again = spots.plan_spots(RIG, CONFIG, used, 20, RADIUS, 0)
    old = np.array([spot.xy for spot in planned[:40]])
    new = np.array([spot.xy for spot in again])
    assert len(again) == 20
    assert np.linalg.norm(new[:, None] - old, axis=2).min() > 2 * RADIUS + spots.MARGIN_M


def test_every_planned_spot_can_be_drawn(planned):
    for spot in planned[:12]:
        pen.stroke(RIG, pen.circle(RIG, spot.xy, RADIUS), spot.yaw, 0.06)


def test_telling_spots_obey_the_same_rules(planned):
    used = [
        ("A", Spot(float(s.xy[0]), float(s.xy[1]), RADIUS, f"{i}")) for i, s in enumerate(planned)
    ]
    telling = spots.plan_spots(RIG, CONFIG, used[:20], 40, RADIUS, 0, telling=True)
    assert len(telling) == 40
    xy, old = np.array([s.xy for s in telling]), np.array([s.xy for s in planned[:20]])
    gaps = np.linalg.norm(xy[:, None] - xy, axis=2) + np.eye(len(xy))
    assert gaps.min() > 2 * RADIUS + spots.MARGIN_M
    assert np.linalg.norm(xy[:, None] - old, axis=2).min() > 2 * RADIUS + spots.MARGIN_M
    yaws = np.degrees([spot.yaw for spot in telling]).round()
    assert sum(np.count_nonzero(yaws == yaw) >= 3 for yaw in np.unique(yaws)) >= 3
    assert sum(drawable(spot) for spot in telling) >= 0.9 * len(telling)  # there are spares


def drawable(spot):
    try:
        pen.stroke(RIG, pen.circle(RIG, spot.xy, RADIUS), spot.yaw, 0.06)
    except MotionRefused:
        return False
    return True


def test_upright_spots_keep_the_drawing_posture_where_they_can():
    some = spots.plan_spots(RIG, CONFIG, [], 20, RADIUS, 1, False)
    assert np.count_nonzero([spot.yaw == 0.0 for spot in some]) >= 12


@pytest.mark.parametrize("telling", [False, True])
def test_on_full_paper_there_is_no_spot(telling):
    full = [("A", Spot(0.0, 0.0, 5.0, "before", "drawn"))]
    assert spots.plan_spots(RIG, CONFIG, full, 4, RADIUS, 0, telling=telling) == []
