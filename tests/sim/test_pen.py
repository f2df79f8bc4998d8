"""The pen: ink where it touches and only there, strokes within limits, touches, mishaps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cellctl.errors import DeviceFault, MotionRefused, NotFound
from cellctl.sim import mishaps, pendant
from cellctl.sim.drawn import drawn
from cellctl.sim.grid import touched_height
from cellctl.sim.motion import TICK_S
from cellctl.sim.pen import Pen
from cellctl.sim.presets import CR
from cellctl.sim.shrink import fitted_circle
from cellctl.sim.truth import draw
from tests.sim.strokes import (
    ABOVE_M,
    JOINT_ACCELERATION,
    JOINT_SPEED,
    RADIUS_M,
    SPOT,
    at_work,
    circle_tips,
    draw_circle,
    go,
    joints_at,
    lines_of,
    settle,
    slowly,
    tips_of,
)

EXACT = replace(
    CR,
    pen_slip_sigma_m=0.0,
    arm_errors=replace(
        CR.arm_errors, repeat_sigma_m=0.0, repeat_sigma_deg=0.0, drawing_repeat_sigma_deg=0.0
    ),
)
"""Nothing random from stroke to stroke, for tests of everything else."""


@pytest.fixture(scope="module")
def truth():
    return draw(CR, 2)


@pytest.fixture
def world(truth):
    return at_work(truth)


@pytest.fixture(scope="module")
def drawn_once(truth):
    """A world in which one circle was drawn, and the joints of its stroke."""
    world = at_work(truth)
    return world, draw_circle(world)


def circle_of(world, stroke):
    """Centre (2,) on the table and radius of what a stroke drew."""
    return fitted_circle(max(lines_of(world, stroke), key=len))


def length_of(world, stroke):
    return sum(np.linalg.norm(np.diff(p, axis=0), axis=1).sum() for p in lines_of(world, stroke))


def test_a_stroke_leaves_one_smooth_circle_where_the_pen_truly_went(drawn_once):
    world, _ = drawn_once
    (line,) = lines_of(world, 0)
    centre, radius = fitted_circle(line)
    assert radius == pytest.approx(RADIUS_M, abs=0.1e-3)
    away = np.linalg.norm(line - centre, axis=1) - radius
    assert np.abs(away).max() < 0.15e-3  # where it came down and was lifted
    round_trip = np.abs(away) < 0.05e-3
    assert round_trip.mean() > 0.9
    inner = line[len(line) // 4 : -len(line) // 4]
    turns = np.diff(np.unwrap(np.arctan2(*np.diff(inner, axis=0).T)))
    assert np.abs(turns - np.median(turns)).max() * np.linalg.norm(inner[1] - inner[0]) < 2e-6
    assert world.arm.collisions(world.now) == []
    assert world.arm.fault(world.now) is None


def test_ink_lands_where_the_pushed_pen_meets_the_bowed_surface(truth):
    """Against the places that scoring calls where the pen lands, nothing random in between."""
    truth = draw(EXACT, 4)
    world = at_work(truth)
    joints = draw_circle(world)
    (line,) = lines_of(world, 0)
    tips = circle_tips(truth)
    low = np.isclose(tips[:, 2], tips[:, 2].min())
    lands = truth.pen_lands(tips[low, :2], joints[low])
    gaps = [np.linalg.norm(truth.table.surface(line)[:, :2] - p[:2], axis=1).min() for p in lands]
    assert max(gaps) < 25e-6  # half the way between two points that were kept, and servos


def test_no_ink_where_the_pen_does_not_touch(world, truth):
    tips = circle_tips(truth, push=-2e-3)
    joints = joints_at(truth, tips)
    go(world, joints[0])
    settle(world, world.draw(joints[1:], slowly(0.03)))
    assert world.arm.pen.ink(world.now) == ()
    assert world.arm.pen.strokes == 1


def test_ink_appears_as_the_pen_goes_on_and_a_move_leaves_some_too(world, truth):
    joints = joints_at(truth, circle_tips(truth))
    go(world, joints[0])
    began = world.now
    ends = world.draw(joints[1:], slowly(0.03))
    lengths = []
    for share in (0.05, 0.4, 0.7, 1.0):
        world.advance(began + share * (ends - began))
        lengths.append(length_of(world, 0))
    assert lengths[0] == 0.0
    assert lengths[1] > 0.02
    assert (np.diff(lengths) > 0.01).all()
    settle(world, ends)
    height = touched_height(truth)
    dot = joints_at(truth, np.array([[0.0, -0.5, height + ABOVE_M], [0.0, -0.5, height - 2e-3]]))
    for target in (dot[0], dot[1], dot[0]):
        go(world, target)
    dots = [line for line, _ in world.arm.pen.ink(world.now) if line.stroke is None]
    assert dots
    assert max(np.ptp(dot.places, axis=0).max() for dot in dots) < 1e-3


def test_beside_the_sheet_there_is_no_ink(world, truth):
    edge = np.array([0.375 - 0.005, -0.44])
    draw_circle(world, centre=edge)
    parts = lines_of(world, 0)
    assert parts
    assert 0.3 < length_of(world, 0) / (2 * np.pi * RADIUS_M) < 0.8
    assert all(truth.sheets[0].under(part).all() for part in parts)


def test_a_stroke_keeps_its_speed_and_the_joints_limits(drawn_once, truth):
    world, joints = drawn_once
    t, followed = world.arm.followed(world.now)
    assert np.allclose(np.diff(t), TICK_S)
    assert np.abs(followed[-1] - joints[-1]).max() < 1e-3
    assert np.abs(followed[0] - joints[0]).max() < 1e-3
    motion = world.arm._motion
    fine = np.arange(t[0], t[-1], 1e-3)
    q, _ = motion.encoders(fine)
    speeds = np.diff(q, axis=0) / 1e-3
    assert np.abs(speeds).max() <= JOINT_SPEED
    assert np.abs(np.diff(speeds, axis=0) / 1e-3).max() <= JOINT_ACCELERATION * 1.02
    tip = np.linalg.norm(np.diff(tips_of(truth, q), axis=0), axis=1) / 1e-3
    top = np.median(tip)
    assert top <= 0.03 + 1e-6
    cruising = tip[int(0.15 * len(tip)) : -int(0.15 * len(tip))]
    assert np.abs(cruising / top - 1).max() < 0.02  # constant, and it never stops


def test_a_smooth_stroke_has_the_speed_that_was_asked_for(world, truth):
    tips = circle_tips(truth, turns=1.1)
    tips = tips[np.isclose(tips[:, 2], tips[:, 2].min())] + (0, 0, 0.01)
    joints = joints_at(truth, tips)
    go(world, joints[0])
    for speed in (0.02, 0.05):
        settle(world, world.draw(joints[1:] if speed == 0.02 else joints[::-1][1:], slowly(speed)))
        _, followed = world.arm.followed(world.now)
        tip = np.linalg.norm(np.diff(tips_of(truth, followed), axis=0), axis=1) / TICK_S
        assert np.median(tip) == pytest.approx(speed, rel=2e-3)


def test_a_fast_stroke_is_slowed_to_what_the_joints_can_do(world, truth):
    joints = joints_at(truth, circle_tips(truth) + (0, 0, 0.02))
    go(world, joints[0])
    settle(world, world.draw(joints[1:], slowly(1.0)))
    t, _ = world.arm.followed(world.now)
    q, _ = world.arm._motion.encoders(np.arange(t[0], t[-1], 1e-3))
    assert np.abs(np.diff(q, axis=0)).max() / 1e-3 <= JOINT_SPEED
    assert np.abs(np.diff(q, 2, axis=0)).max() / 1e-6 <= JOINT_ACCELERATION * 1.02


def test_a_stroke_that_jumps_or_goes_nowhere_is_refused(world, truth):
    joints = joints_at(truth, circle_tips(truth))
    go(world, joints[0])
    with pytest.raises(MotionRefused, match=r"waypoint 0 is .* mm of the tip from where the pen"):
        world.draw(joints[10:], slowly(0.03))
    with pytest.raises(MotionRefused, match=r"waypoint 1 is .* mm of the tip from waypoint 0"):
        world.draw(joints[[1, 9]], slowly(0.03))
    with pytest.raises(MotionRefused, match="too short to be followed"):
        world.draw(world.arm.read(world.now).joints[None], slowly(0.03))
    assert world.arm.pen.strokes == 0
    assert world.arm.read(world.now).standstill_s > 0


def test_the_spring_gives_way_by_its_travel_and_no_further(world, truth):
    draw_circle(world, push=3.5e-3)
    assert world.arm.collisions(world.now) == []
    joints = joints_at(truth, circle_tips(truth, push=9e-3))
    go(world, joints[0])
    settle(world, world.draw(joints[1:], slowly(0.03)))
    (collision,) = world.arm.collisions(world.now)
    assert collision.between == ("pen", "table")
    assert "the pen holder is at the end of its travel" in world.arm.fault(world.now)
    press = world.arm.pen.press(np.array([collision.t]), world.arm.frames(np.array([collision.t])))
    assert press.depth[0] == pytest.approx(CR.pen.travel_m, abs=0.02e-3)
    with pytest.raises(DeviceFault, match="end of its travel"):
        go(world, joints[0])
    world.arm.clear_fault(world.now)
    go(world, joints[0])  # and back up
    assert len(world.arm.collisions(world.now)) == 1


def test_strokes_scatter_as_specified(truth):
    """Repeatability per stroke, and the pen's slip in its holder."""
    world, centres = at_work(truth), []
    joints = joints_at(truth, circle_tips(truth, radius=0.006))
    go(world, joints[0])
    for i in range(40):
        settle(world, world.draw(joints[1:], slowly(0.05), f"{i}"))
        centres.append(circle_of(world, i)[0])
    lever = np.radians(0.01) * np.linalg.norm(truth.pen)
    expected = np.sqrt(0.15e-3**2 + 0.058e-3**2 + lever**2)
    spread = np.std(centres, axis=0, ddof=1)
    assert spread == pytest.approx([expected] * 2, rel=5 / np.sqrt(2 * len(centres)))


def test_the_same_sample_is_the_same_ink_whatever_was_before(truth):
    def line(*before):
        world = at_work(truth)
        for i in range(len(before)):
            draw_circle(world, before[i], centre=SPOT + 0.02)
        draw_circle(world, "sample#0")
        return lines_of(world, len(before))[0]

    straight, detoured = line(), line("other#0", "sample#1")
    assert len(straight) == len(detoured)
    assert np.abs(straight - detoured).max() < 1e-10
    assert np.array_equal(straight, line())


def test_ink_does_not_depend_on_how_time_is_sliced(truth):
    joints = joints_at(truth, circle_tips(truth))
    found = []
    for step in (0.0072, 5.0):
        world = at_work(truth)
        go(world, joints[0])
        ends = world.draw(joints[1:], slowly(0.05))
        while world.now < ends + 1.0:
            world.advance(min(world.now + step, ends + 1.0))
        found.append(lines_of(world, 0)[0])
    assert np.array_equal(*found)


@pytest.mark.parametrize("hard", [False, True])
def test_a_stop_in_mid_stroke_leaves_half_a_circle(world, truth, hard):
    joints = joints_at(truth, circle_tips(truth))
    go(world, joints[0])
    began = world.now
    ends = world.draw(joints[1:], slowly(0.03))
    world.advance((began + ends) / 2)
    world.arm.stop(world.now, hard=hard)
    stopped = world.arm.moving_until()
    assert stopped < world.now + 0.2
    settle(world, stopped)
    assert 0.3 < length_of(world, 0) / (2 * np.pi * RADIUS_M) < 0.7
    _, followed = world.arm.followed(world.now)
    reached = np.abs(followed[-1] - joints).max(axis=1).min()
    assert reached < 2e-3  # still on the way
    length = length_of(world, 0)
    world.advance(world.now + 10)
    assert length_of(world, 0) == length


def touch_down(world, truth, spot, key, speed=0.01):
    """Where the controller believes the tip (3,) when the touch was felt."""
    height = touched_height(truth)
    fall = np.arange(height + 5e-3, height - 4e-3, -0.5e-3)
    joints = joints_at(truth, np.column_stack([np.tile(spot, (len(fall), 1)), fall]))
    go(world, joints[0], key)
    settle(world, world.touch(joints[1:], slowly(speed), key))
    felt = world.arm.felt(world.now)
    return None if felt is None else tips_of(truth, felt.joints[None])[0]


def test_a_touch_is_felt_at_the_surface_and_the_arm_stands_there():
    truth = draw(EXACT, 6)
    world, depths = at_work(truth), []
    for i in range(16):
        assert touch_down(world, truth, SPOT, f"{i}") is not None
        felt = world.arm.felt(world.now)
        frames = world.arm.frames(np.array([felt.t, world.now]))
        press = world.arm.pen.press(np.array([felt.t, world.now]), frames)
        depths.append(press.depth[0])
        assert 0 <= press.depth[1] - press.depth[0] < 0.3e-3  # braking
        assert world.arm.read(world.now).standstill_s > 0
    assert np.mean(depths) == pytest.approx(0.2e-3, abs=0.03e-3)
    assert np.std(depths) == pytest.approx(0.03e-3, rel=0.7)
    assert world.arm.pen.strokes == 0
    assert world.arm.collisions(world.now) == []
    dots = [line for line, _ in world.arm.pen.ink(world.now)]
    assert max(np.ptp(dot.places, axis=0).max() for dot in dots) < 0.1e-3


def test_a_touch_in_the_air_is_not_felt(world, truth):
    assert touch_down(world, truth, SPOT, "a") is not None
    height = touched_height(truth)
    fall = np.arange(height + 0.02, height + 0.01, -0.5e-3)
    joints = joints_at(truth, np.column_stack([np.tile(SPOT, (len(fall), 1)), fall]))
    go(world, joints[0])
    settle(world, world.touch(joints[1:], slowly(0.01)))
    assert world.arm.felt(world.now) is None


def test_planted_changes_wait_for_their_stroke(world, truth):
    mishap = np.array([0.003, 0.0, 0.0])
    world.after_strokes(2, lambda: mishaps.shift_pen(world, mishap))
    before = world.truth.pen
    for i in range(4):
        draw_circle(world, f"s{i}", centre=SPOT + (0.0, -0.04 * i))
        assert np.array_equal(world.truth.pen, before + (mishap if i >= 2 else 0.0))
    centres = np.array([circle_of(world, i)[0] for i in range(4)]) - [
        SPOT + (0.0, -0.04 * i) for i in range(4)
    ]
    jumps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    assert jumps[1] == pytest.approx(3e-3, abs=0.8e-3)
    assert max(jumps[0], jumps[2]) < 0.9e-3
    world.after_strokes(1, lambda: mishaps.shift_pen(world, -mishap))  # long past: at once
    assert np.allclose(world.truth.pen, before)


def test_a_dry_pen_and_a_weak_one(world):
    world.after_strokes(1, lambda: mishaps.dry_pen(world))
    world.after_strokes(3, lambda: mishaps.weaken_pen(world, 0.4, 1))
    for i in range(2):
        draw_circle(world, centre=SPOT + (0.04 * i, 0))
    mishaps.fill_pen(world)
    for i in range(2, 5):
        draw_circle(world, centre=SPOT + (-0.04 * i, 0))
    lengths = np.array([length_of(world, i) for i in range(5)]) / (2 * np.pi * RADIUS_M)
    assert lengths == pytest.approx([1, 0, 1, 0.4, 1], abs=0.02)


def test_corners_that_are_cut_shrink_circles_and_encoders_show_it(world, truth):
    mishaps.shrink_drawing(world, 0.9)
    joints = draw_circle(world)
    _, followed = world.arm.followed(world.now)
    assert circle_of(world, 0)[1] == pytest.approx(0.9 * RADIUS_M, rel=0.02)
    tips = tips_of(truth, followed)
    low = tips[tips[:, 2] < tips[:, 2].min() + 0.5e-3]
    assert fitted_circle(low[:, :2])[1] == pytest.approx(0.9 * RADIUS_M, rel=0.02)
    assert np.abs(followed[-1] - joints[-1]).max() < 1e-3
    mishaps.shrink_drawing(world, 1.0)
    draw_circle(world)
    assert circle_of(world, 1)[1] == pytest.approx(RADIUS_M, rel=0.02)


def test_ink_moves_with_its_sheet_and_goes_with_it(world, truth):
    draw_circle(world)
    before = drawn(world.truth, world.arm.pen.ink(world.now))[0]
    mishaps.move_sheet(world, "A", np.array([0.01, -0.02]), np.radians(3.0))
    after = drawn(world.truth, world.arm.pen.ink(world.now))[0]
    middle = np.array(CR.table.centre_m[:2])
    c, s = np.cos(np.radians(3.0)), np.sin(np.radians(3.0))
    turned = np.array([[c, -s], [s, c]]) @ (np.array(before["centre_m"])[:2] - middle)
    expected = middle + turned + (0.01, -0.02)
    assert after["centre_m"][:2] == pytest.approx(expected, abs=1e-5)
    mishaps.replace_sheet(world, None)
    assert drawn(world.truth, world.arm.pen.ink(world.now)) == []
    fresh = world.truth.sheets[0]
    assert np.array_equal(fresh.centre, truth.sheets[0].centre)
    with pytest.raises(NotFound, match="no sheet 'B'"):
        mishaps.move_sheet(world, "B", np.zeros(2), 0.0)


def test_a_person_places_the_pen_by_eye(truth):
    world, errors = at_work(truth), []
    rotation = np.diag([1.0, -1.0, -1.0])
    for i in range(12):
        point = truth.table.surface(np.array([0.05 * (i % 4) - 0.1, 0.04 * (i // 4)]))
        settle(world, pendant.place(world, point, rotation))
        flange = world.arm.frames(np.array([world.now]))[0, -1]
        errors.append(flange[:3, :3] @ truth.pen + flange[:3, 3] - point)
        assert np.degrees(np.abs(flange[:3, :3] - rotation).max()) < 0.2
    assert np.std(errors) == pytest.approx(0.1e-3, rel=0.4)
    assert world.arm.collisions(world.now) == []
    with pytest.raises(MotionRefused, match="does not reach"):
        pendant.place(world, np.array([3.0, 0.0, 0.0]), rotation)


def test_a_person_jogs_without_a_guard(world):
    joints = np.radians([-76.0, -84.0, -111.0, -75.0, 90.0, -150.0])
    settle(world, pendant.jog(world, joints))
    assert np.abs(world.arm.read(world.now).joints - joints).max() < 1e-3


def test_old_ink_is_forgotten_only_when_nobody_can_see_it(world):
    draw_circle(world)
    mishaps.replace_sheet(world, "A")
    assert len(world.arm.pen.ink(world.now)) == 1  # a frame from before may still wait
    while world.stream.dequeue():
        pass
    world.advance(world.now + 200.0)
    while world.stream.dequeue():
        pass
    world.advance(world.now + 200.0)
    assert world.arm.pen.ink(world.now) == ()


def test_a_pen_high_over_the_table_touches_nothing():
    """However it lies: its axis may meet the bowed table's parabola far from the tip."""
    truth, rng, count = draw(CR, 2), np.random.default_rng(0), 20_000
    frames = np.tile(np.eye(4), (count, 7, 1, 1))
    frames[:, 6, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    frames[:, 6, :3, 3] = rng.uniform((-0.6, -0.9, 0.3), (0.6, 0.3, 1.2), (count, 3))
    assert (Pen(truth).press(np.arange(float(count)), frames).depth < 0.0).all()
