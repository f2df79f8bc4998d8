"""The world: free-running camera, late glass, keyed randomness, time that others bring."""

from __future__ import annotations

import numpy as np
import pytest

from cellctl.sim.camera import Stream
from cellctl.sim.glass import Glass
from cellctl.sim.motion import Limits
from cellctl.sim.optics import Renderer
from cellctl.sim.presets import CR
from cellctl.sim.truth import draw
from cellctl.sim.world import World

PERIOD = 1 / 30
LATE = 0.0167 + 0.060
HOME = np.radians(CR.home_deg)
WORK = np.radians([-76.0, -84.0, -111.0, -75.0, 90.0, -166.0])
LIMITS = Limits(np.full(6, np.radians(40)), np.full(6, np.radians(80)), 0.5)
BLACK = np.zeros((1080, 1920), dtype=np.uint8)
WHITE = np.full((1080, 1920), 255, dtype=np.uint8)


@pytest.fixture
def stream():
    return Stream(CR.camera, t=0.0)


@pytest.fixture(scope="module")
def truth():
    return draw(CR, 2)


@pytest.fixture
def world(truth):
    return World(truth)


def drain(stream):
    frames = []
    while frame := stream.dequeue():
        frames.append(frame)
    return frames


def test_after_a_pause_the_first_frames_are_old_and_the_newest_are_lost(stream):
    stream.advance(10.0)
    old = drain(stream)
    assert [f.sequence for f in old] == [0, 1, 2, 3]
    assert old[0].t == 0.0
    stream.advance(10.0 + 2 * PERIOD)
    (first, *_) = drain(stream)
    assert first.sequence > 290  # a gap in the numbers tells of the lost ones
    assert first.t + LATE == pytest.approx(10.0, abs=PERIOD)


def test_frames_come_exactly_when_promised(stream):
    for number in range(200):
        ready = stream.ready_at()
        assert ready == pytest.approx(number * PERIOD + LATE)
        stream.advance(ready - 1e-6)
        assert stream.dequeue() is None
        stream.advance(ready)
        assert stream.dequeue().sequence == number


def test_lost_frames_leave_a_gap(stream):
    stream.lose(3)
    stream.advance(stream.ready_at())
    assert stream.dequeue().sequence == 3


def test_a_hanging_camera_repeats_its_picture_with_new_stamps(stream):
    stream.hang(1.0, 0.5)
    seen = []
    for t in np.arange(0.9, 1.8, PERIOD):
        stream.advance(t)
        seen += drain(stream)
    hung = [f for f in seen if 1.0 <= f.t < 1.5]
    assert len(hung) > 10
    assert {f.seen for f in hung} == {1.0}
    assert all(f.seen == f.t for f in seen if f not in hung)


def test_the_glass_is_late_by_a_drawn_time_in_order():
    delays = []
    for i in range(400):
        glass = Glass(3, CR.projector, t=0.0)
        glass.show(1.0, WHITE, f"{i}")
        dark = sum(share for share, picture in glass.between(1.0, 2.0) if picture is None)
        delays.append(dark)
    assert np.mean(delays) == pytest.approx(0.035, abs=5 * 0.008 / 20)
    assert np.std(delays) == pytest.approx(0.008, rel=0.2)
    glass = Glass(3, CR.projector, t=0.0)
    for i in range(50):  # shown in one instant: the last one stays, whatever the draws are
        glass.show(1.0, np.full_like(BLACK, i), f"{i}")
    ((share, picture),) = glass.between(1.5, 1.6)
    assert share == 1.0
    assert picture is not None
    assert picture.image[0, 0] == 49


def test_a_dark_lamp_and_its_return():
    glass = Glass(3, CR.projector, t=0.0)
    glass.show(1.0, WHITE, "a")
    glass.switch(2.0, on=False)
    assert glass.between(2.0, 2.1) == ((1.0, None),)
    glass.show(2.0, BLACK, "b")
    assert glass.between(3.0, 3.1) == ((1.0, None),)
    glass.switch(4.0, on=True)
    ((_, picture),) = glass.between(4.1, 4.2)
    assert picture is not None
    assert picture.image is BLACK


def test_a_naive_show_and_grab_gets_the_old_picture(world):
    """Neither the glass nor the camera's buffers wait for anybody."""
    world.advance(1.0)
    world.show(WHITE)
    frame = world.dequeue()
    assert frame.capture.t < 1.0
    assert frame.instants[0].light == ((1.0, None),)
    # Even the first exposure after `show` returned has not seen the picture yet.
    while frame.capture.t < 1.0:
        world.advance(max(world.now, world.stream.ready_at()))
        frame = world.dequeue()
    assert frame.instants[0].light[0][1] is None


def test_an_exposure_over_a_change_is_a_mixture(world):
    world.advance(1.0)
    world.show(WHITE, "x")
    shares = []
    for _ in range(12):
        world.advance(max(world.now, world.stream.ready_at()))
        frame = world.dequeue()
        shares.append(sum(s for s, p in frame.instants[0].light if p is not None))
    assert 0.0 in shares
    assert shares[-1] == 1.0


def test_an_exposure_during_a_motion_is_split_and_at_rest_it_is_not(world):
    world.advance(0.5)
    end = world.move(WORK[None], LIMITS)
    counts = {}
    while world.now < end + 1.5:
        world.advance(max(world.now, world.stream.ready_at()))
        frame = world.dequeue()
        counts[frame.capture.t] = len(frame.instants)
        assert sum(i.share for i in frame.instants) == pytest.approx(1.0)
    assert {n for t, n in counts.items() if t < 0.45} == {1}
    assert min(n for t, n in counts.items() if 1.0 < t < end - 0.5) > 3
    assert max(n for t, n in counts.items() if end < t < end + 0.2) > 1  # the ring blurs, too
    assert {n for t, n in counts.items() if t > end + 0.5} == {1}


def test_old_frames_show_what_was_there_when_they_were_exposed(world):
    """Rendered only when asked for, with the state of the exposure."""
    world.advance(0.2)
    world.move(WORK[None], LIMITS)
    world.advance(3600.0)  # an hour's pause
    frames = world.dequeue().instants[0].frames
    assert np.allclose(frames, world.truth.arm.link_frames(HOME), atol=1e-6)
    assert np.array_equal(frames, world.arm.frames(np.array([-1.0]))[0])


def test_a_named_sample_taken_again_is_the_same_and_others_never_are(truth):
    renderer = Renderer(truth.seed, CR.camera)

    def take(world, sample, via):
        """Move, look twice; pictures and joints."""
        world.advance(world.now + 0.1)
        world.advance(world.move(np.array([via, WORK]), LIMITS, f"{sample}#0") + 1.0)
        pictures = []
        for count in range(2):
            while (frame := world.dequeue()) is None or frame.capture.t < world.now - 0.2:
                world.advance(max(world.now, world.stream.ready_at()))
            index = world.noise_index(frame, f"{sample}#{count}")
            pictures.append(renderer.picture(frame.truth, frame.instants, index))
        return pictures, world.arm.read(world.now).joints

    straight, detour = World(truth), World(truth)
    first, joints = take(straight, "a/1", HOME + 0.1)
    take(detour, "a/0", WORK + 0.2)
    again, joints_again = take(detour, "a/1", HOME + 0.2)
    other, _ = take(detour, "a/2", HOME + 0.1)
    assert np.array_equal(joints, joints_again)
    for one, two in zip(first, again, strict=True):
        assert np.array_equal(one, two)
    assert not np.array_equal(first[0], first[1])
    assert not np.array_equal(first[0], other[0])


def test_unnamed_requests_are_counted(world):
    assert [world.index("sensor", None) for _ in range(3)] == ["0", "1", "2"]
    assert world.index("move", None) == "0"
    assert world.index("sensor", "x#0") == world.index("sensor", "x#0") == "sample x#0"


def test_a_nudge_moves_the_device_from_then_on(world):
    world.advance(1.0)
    before = world.truth.camera.pose
    world.nudge("camera", np.array([0.003, 0, 0]), np.radians([0, 0, 1.0]))
    old = world.dequeue()
    world.advance(2.0)
    new = world.dequeue()
    while new.capture.t < 1.0:
        world.advance(max(world.now, world.stream.ready_at()))
        new = world.dequeue()
    assert np.array_equal(old.truth.camera.pose.matrix, before.matrix)
    shift = new.truth.camera.pose.translation - before.translation
    assert np.linalg.norm(shift) == pytest.approx(0.003)


def test_time_never_goes_back(world):
    world.advance(5.0)
    world.advance(4.0)
    assert world.now == 5.0


def test_history_is_forgotten_but_not_too_early(world):
    for i in range(40):
        world.advance(world.now + 5.0)
        world.move((HOME + 0.02 * (i % 2))[None], LIMITS)
        world.show(BLACK)
        while world.dequeue():
            pass
    world.advance(world.now + 5.0)
    assert len(world.arm._motion._legs) < 20
    assert len(world.glass._history) < 20
    assert world.arm.read_at(world.now - 55.0, world.now).joints.shape == (6,)
