"""The arm's motion: limits, synchrony, braking, ringing, repeatability, contact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cellctl.errors import DeviceFault, MotionRefused
from cellctl.geometry import Transform, pose_matrix
from cellctl.sim.contact import Obstacles
from cellctl.sim.motion import (
    RING_S,
    STILL_RAD_S,
    TICK_S,
    Course,
    Limits,
    Motion,
)
from cellctl.sim.presets import CR
from cellctl.sim.robot import Arm
from cellctl.sim.truth import draw

HOME = np.radians(CR.home_deg)
WORK = np.radians([-76.0, -84.0, -111.0, -75.0, 90.0, -166.0])
LIMITS = Limits(np.full(6, np.radians(40)), np.full(6, np.radians(80)), 0.5)


@pytest.fixture(scope="module")
def truth():
    return draw(CR, 1)


@pytest.fixture
def motion(truth):
    arms = (truth.nominal_arm, truth.arm)
    return Motion(arms, truth.nominal_pen, HOME, truth.ring_hz, t=0.0)


@pytest.fixture
def arm(truth):
    return Arm(truth, 0.0)


def follow(motion, waypoints, limits=LIMITS, t=1.0):
    end = motion.follow(t, np.atleast_2d(waypoints), limits, np.zeros(6))
    times = np.arange(t, end, 1e-3)
    joints, speeds = motion.encoders(times)
    return end, times, joints, speeds


def assert_on_the_line(joints):
    """All joints are equally far on their ways from HOME to WORK."""
    ways = WORK - HOME
    turning = ways != 0
    share = (joints - HOME)[:, turning] / ways[turning]
    assert np.ptp(share, axis=1).max() < 1e-6
    assert (joints == HOME)[:, ~turning].all()


def test_a_trapezoid_keeps_its_limits_and_arrives():
    for rate, gain in ((0.5, 2.0), (5.0, 2.0)):  # with and without a flat top
        course = Course.trapezoid(rate, gain)
        times = np.linspace(0, course.duration, 4001)
        way, speed = course.at(times)
        assert way[-1] == pytest.approx(1.0)
        assert speed.max() <= rate + 1e-9
        assert np.abs(np.diff(speed[:-1]) / np.diff(times[:-1])).max() <= gain + 1e-6
        assert np.allclose(np.gradient(way, times)[1:-2], speed[1:-2], atol=1e-2)


def test_joints_move_together_under_their_limits(motion, truth):
    end, times, joints, speeds = follow(motion, WORK)
    assert_on_the_line(joints)
    assert np.abs(speeds).max() <= np.radians(40) + 1e-9
    change = np.diff(speeds, axis=0) / np.diff(times)[:, None]
    assert np.abs(change[10:-10]).max() <= np.radians(80) * 1.01  # past the dead band
    assert np.abs(speeds).max() > np.radians(39)
    tips = truth.nominal_arm.forward(joints) @ (*truth.nominal_pen, 1.0)
    assert (np.linalg.norm(np.diff(tips[:, :3], axis=0), axis=1) / 1e-3).max() <= 0.5 * 1.01
    assert np.array_equal(motion.encoders(np.array([end + 1.0]))[0][0], WORK)


def test_nothing_exceeds_the_arm_s_own_limits(motion, truth):
    fast = Limits(np.full(6, 100.0), np.full(6, 1000.0), 100.0)
    _, times, _, speeds = follow(motion, WORK, fast)
    assert (np.abs(speeds).max(axis=0) <= truth.nominal_arm.max_speed + 1e-9).all()
    change = np.abs(np.diff(speeds, axis=0)[10:-10]) / np.diff(times)[0]
    assert change.max() <= truth.nominal_arm.max_acceleration.max() * 1.01


def test_it_stops_at_every_waypoint(motion):
    via = (HOME + WORK) / 2 + 0.1
    _, _, joints, speeds = follow(motion, [via, WORK])
    nearest = np.abs(joints - via).max(axis=1).argmin()
    assert np.abs(joints[nearest] - via).max() < 1e-3
    assert np.abs(speeds[nearest]).max() < 0.02


@pytest.mark.parametrize("hard", [False, True])
def test_braking_is_as_hard_as_allowed_and_stays_on_the_way(motion, truth, hard):
    end, *_ = follow(motion, WORK)
    middle = (1.0 + end) / 2
    motion.stop(middle, hard=hard)
    assert middle < motion.standstill_at() < end
    times = np.arange(middle, motion.standstill_at(), 1e-3)
    joints, speeds = motion.encoders(times)
    gain = np.abs(np.diff(speeds, axis=0)[2:-2]).max() / 1e-3
    own = truth.nominal_arm.max_acceleration.max()
    assert gain == pytest.approx(own if hard else np.radians(80), rel=0.02)
    assert_on_the_line(joints)
    motion.stop(motion.standstill_at() + 1, hard=hard)  # idempotent
    at_rest = motion.encoders(np.array([end + 5.0]))
    assert np.allclose(at_rest[0][0], joints[-1], atol=1e-3)
    assert not at_rest[1].any()


def test_the_ring_is_seen_at_the_flange_hardly_by_the_encoders_and_ends(motion, truth):
    end, *_ = follow(motion, WORK)
    times = end + np.arange(0, 0.6, 1e-3)
    frames = motion.frames(times)
    rest = motion.frames(np.array([end + 10.0]))[0]
    away = np.linalg.norm(frames[:, 6, :3, 3] - rest[6, :3, 3], axis=1)
    assert 0.1e-3 < away.max() < 0.8e-3
    assert away[times - end > 0.3].max() < 0.1 * away.max()
    assert np.array_equal(frames[times - end > RING_S], np.tile(rest, (99, 1, 1, 1)))
    joints, speeds = motion.encoders(times)
    seen = truth.arm.forward(joints)
    seen = np.linalg.norm(seen[:, :3, 3] - truth.arm.forward(WORK)[:3, 3], axis=1)
    assert seen.max() < 0.2 * away.max()
    # Zero reported joint speed alone is not yet a sharp picture.
    still = ~speeds.any(axis=1)
    assert away[still].max() > 0.02e-3
    swing = (frames[:, 6, :3, 3] - rest[6, :3, 3]) @ (frames[20, 6, :3, 3] - rest[6, :3, 3])
    crossings = np.nonzero(np.diff(np.sign(swing[5:300])))[0]
    assert 8 <= 1 / (2 * np.diff(crossings).mean() * 1e-3) <= 12


def test_reported_speeds_have_a_dead_band(motion):
    end, *_ = follow(motion, WORK)
    _, speeds = motion.encoders(end + np.arange(0, 0.5, 1e-3))
    assert np.abs(speeds[speeds != 0]).min() >= STILL_RAD_S


def test_standstill_counts_from_the_last_reported_motion(motion):
    end, *_ = follow(motion, WORK)
    assert motion.standstill_s(int((1.0 + end) / 2 / TICK_S)) == 0
    tick = int(np.ceil((end + 3.0) / TICK_S))
    lasted = motion.standstill_s(tick)
    assert 3.0 - RING_S <= lasted <= 3.0 + 2 * TICK_S
    assert motion.standstill_s(tick + 10) == pytest.approx(lasted + 10 * TICK_S)


def test_the_same_goal_is_the_same_pose_to_the_last_bit_whatever_the_way(truth):
    results = []
    for via in (HOME + 0.3, HOME + 0.2):
        arm = Arm(truth, 0.0)
        end = arm.move(1.0, np.array([via, WORK]), LIMITS, "sample a#0")
        results.append((arm.frames(np.array([end + 1.0])), arm.read(end + 1.0).joints))
    again = arm.move(end + 2.0, WORK[None], LIMITS, "sample a#0")
    results.append((arm.frames(np.array([again + 1.0])), arm.read(again + 1.0).joints))
    other = arm.move(again + 2.0, WORK[None], LIMITS, "sample b#0")
    for frames, joints in results:
        assert np.array_equal(frames, results[0][0])
        assert np.array_equal(joints, results[0][1])
    assert not np.array_equal(arm.frames(np.array([other + 1.0])), results[0][0])


def test_repeatability_is_as_specified(truth):
    arm, t, poses = Arm(truth, 0.0), 1.0, []
    for i in range(120):
        t = arm.move(t, WORK[None], LIMITS, f"{i}") + 1.0
        flange = arm.frames(np.array([t]))[0, 6]
        reached = truth.arm.forward(arm.read(t).joints)
        poses.append(np.linalg.inv(reached) @ flange)
    errors = np.array(poses)
    shift = errors[:, :3, 3]
    turn = np.stack([errors[:, 2, 1], errors[:, 0, 2], errors[:, 1, 0]], axis=1)
    tolerance = 5 / np.sqrt(2 * shift.size)
    assert shift.std() == pytest.approx(0.058e-3, rel=tolerance)
    assert np.degrees(turn).std() == pytest.approx(0.02, rel=tolerance)


def test_reported_pose_is_nominal_kinematics_of_the_encoders(arm, truth):
    end = arm.move(1.0, WORK[None], LIMITS, "0")
    reading = arm.read(end + 2.0)
    assert np.array_equal(reading.flange, truth.nominal_arm.forward(reading.joints))
    true = arm.frames(np.array([end + 2.0]))[0, 6]
    assert 0.1e-3 < np.linalg.norm(true[:3, 3] - reading.flange[:3, 3]) < 5e-3


def test_state_is_interpolated_between_measurements(arm):
    end = arm.move(1.0, WORK[None], LIMITS, "0")
    now = end + 1.0
    t = 1.0 + 0.4 * (end - 1.0) + 0.003
    found = arm.read_at(t, now)
    before, after = (arm.read(tick * TICK_S) for tick in (t // TICK_S, t // TICK_S + 1))
    assert (found.joints > np.minimum(before.joints, after.joints) - 1e-12).all()
    assert (found.joints < np.maximum(before.joints, after.joints) + 1e-12).all()
    assert found.standstill_s == 0
    assert arm.read_at(now - 1e-3, now).standstill_s > 0.4
    for outside in (now + 0.1, -5.0):
        with pytest.raises(DeviceFault, match="the record covers"):
            arm.read_at(outside, now)


def test_a_second_move_and_an_unreachable_one_are_refused(arm):
    with pytest.raises(MotionRefused, match="waypoint 1 is outside the joint limits"):
        arm.move(1.0, np.array([WORK, WORK + 10.0]), LIMITS, "0")
    arm.move(1.0, WORK[None], LIMITS, "0")
    with pytest.raises(DeviceFault, match="moving already"):
        arm.move(1.5, HOME[None], LIMITS, "1")


def down(joints, degrees):
    """Lower the arm by turning its shoulder."""
    lowered = joints.copy()
    lowered[1] -= np.radians(degrees)
    return lowered


def test_contact_with_the_table_stops_the_arm_and_is_counted(arm, truth):
    t = arm.move(1.0, WORK[None], LIMITS, "0") + 1.0
    obstacles = Obstacles(truth)
    reached = down(WORK, 40)
    assert obstacles.nearest(truth.arm.link_frames(reached)).gap < -0.05
    end = arm.move(t, reached[None], LIMITS, "1")
    assert arm.collisions(t + 0.01) == []
    assert arm.fault(t + 0.01) is None
    (collision,) = arm.collisions(end)
    assert "table" in collision.between
    assert "protective stop" in arm.fault(end)
    gap = obstacles.nearest(arm.frames(np.array([end + 1.0]))[0]).gap
    assert -0.02 < gap < 0.005
    with pytest.raises(DeviceFault, match="touched table"):
        arm.move(end + 1.0, WORK[None], LIMITS, "2")
    arm.clear_fault(end + 1.0)
    back = arm.move(end + 1.0, WORK[None], LIMITS, "2")
    assert len(arm.collisions(back)) == 1
    assert np.abs(arm.read(back + 1.0).joints - WORK).max() < 1e-3


def test_a_stop_in_time_prevents_the_contact(arm):
    t = arm.move(1.0, WORK[None], LIMITS, "0") + 1.0
    end = arm.move(t, down(WORK, 40)[None], LIMITS, "1")
    arm.stop(t + 0.2, hard=True)
    assert arm.moving_until() < end
    assert arm.collisions(end + 1.0) == []
    assert arm.fault(end + 1.0) is None


@pytest.mark.parametrize("device", ["camera", "projector"])
def test_bodies_of_camera_and_projector_can_be_touched(truth, device):
    """A ball of 0.05 m around the optical centre, against the arm's true hull."""
    flange = truth.arm.forward(WORK)[:3, 3]
    for away, touched in ((0.03, True), (0.13, False)):
        pose = Transform("world", device, pose_matrix((np.pi, 0, 0), flange + (0, 0, 0.1 + away)))
        moved = replace(truth, **{device: replace(getattr(truth, device), pose=pose)})
        obstacles = Obstacles(moved)
        gaps = obstacles.gaps(truth.arm.link_frames(WORK)[None])[0]
        named = zip(gaps, obstacles.pairs, strict=True)
        near = min(gap for gap, (_, other) in named if other == device)
        assert (near < 0) == touched
