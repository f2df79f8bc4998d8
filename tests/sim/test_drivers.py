"""The drivers' contracts, against a world process that behaves like a cell."""

from __future__ import annotations

import asyncio
import socket
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cellctl.drivers.base import SAMPLE
from cellctl.drivers.base import Path as JointPath
from cellctl.errors import BadInput, DeviceFault, MotionRefused
from cellctl.sim.drivers import GOAL_RAD, STANDSTILL_S
from cellctl.sim.link import Link
from cellctl.sim.motion import RING_S
from tests.sim.worlds import NEAR, WORK, devices, to, world

BLACK = np.zeros((1080, 1920), dtype=np.uint8)
WHITE = np.full((1080, 1920), 255, dtype=np.uint8)


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory):
    with world(tmp_path_factory.mktemp("stepped")) as running:
        yield running


@pytest.fixture(scope="module")
def paced(tmp_path_factory):
    with world(tmp_path_factory.mktemp("paced"), time="paced") as running:
        yield running


@pytest.fixture(scope="module")
def battered(tmp_path_factory):
    """A world for what leaves traces."""
    with world(tmp_path_factory.mktemp("battered"), seed=1) as running:
        yield running


@pytest.fixture(params=["stepped", "paced"])
def either(request):
    return request.getfixturevalue("endpoint" if request.param == "stepped" else "paced")


async def test_devices_say_who_they_are(endpoint):
    async with devices(endpoint) as cell:
        assert (await cell.robot.identity()).model == "ur5"
        assert (await cell.camera.identity()).model == "1920x1080"
        assert (await cell.projector.identity()).serial == "cr-0"


async def test_a_move_ends_at_standstill_at_its_goal(either):
    async with devices(either) as cell:
        await cell.robot.move(to(WORK), timeout_s=30)
        state = await cell.robot.move(to(WORK + 0.02, NEAR, speed=0.5), timeout_s=30)
        assert state.standstill_s >= STANDSTILL_S
        assert not state.speeds.any()
        assert np.abs(state.joints - NEAR).max() < GOAL_RAD
        assert state.T_world_flange.parent == "world"
        newest = await cell.robot.read()
        assert newest.t >= state.t
        assert await cell.scorer.collisions() == []


async def test_speed_scales_the_move(endpoint):
    async with devices(endpoint) as cell:
        durations = []
        for speed in (1.0, 0.25):
            await cell.robot.move(to(WORK), timeout_s=30)
            began = cell.clock.now()
            await cell.robot.move(to(WORK + 0.5 * np.eye(6)[5], speed=speed), timeout_s=30)
            durations.append(cell.clock.now() - began)
        assert durations[1] > 2 * durations[0]


async def test_outside_the_joint_limits_nothing_moves(endpoint):
    async with devices(endpoint) as cell:
        before = await cell.robot.move(to(WORK), timeout_s=30)
        far = JointPath(np.array([NEAR, WORK + 10.0]))
        with pytest.raises(MotionRefused, match="waypoint 1 is outside the joint limits"):
            await cell.robot.check(far)
        with pytest.raises(MotionRefused, match="joint limits"):
            await cell.robot.move(to(*far.waypoints), timeout_s=30)
        assert np.array_equal((await cell.robot.read()).joints, before.joints)
        await cell.robot.check(JointPath(NEAR[None]))


async def test_cancelling_a_move_stops_the_arm_before_it_returns(paced):
    async with devices(paced) as cell:
        await cell.robot.move(to(WORK), timeout_s=30)
        move = asyncio.create_task(cell.robot.move(to(WORK + 0.6), timeout_s=30))
        await asyncio.sleep(0.4)
        cancelled = time.monotonic()
        move.cancel()
        with pytest.raises(asyncio.CancelledError):
            await move
        assert time.monotonic() - cancelled < 2.0
        state = await cell.robot.read()
        assert state.standstill_s > 0
        gone = np.abs(state.joints - WORK).max()
        assert 0.01 < gone < 0.4


async def test_cancelling_twice_still_stops_the_arm(paced):
    async with devices(paced) as cell:
        await cell.robot.move(to(WORK), timeout_s=30)
        move = asyncio.create_task(cell.robot.move(to(WORK + 0.6), timeout_s=30))
        await asyncio.sleep(0.3)
        for _ in range(3):
            move.cancel()
            await asyncio.sleep(0.01)
        with pytest.raises(asyncio.CancelledError):
            await move
        assert (await cell.robot.read()).standstill_s >= STANDSTILL_S


async def test_a_move_cancelled_at_once_does_not_run_on(endpoint):
    async with devices(endpoint) as cell:
        await cell.robot.move(to(WORK), timeout_s=30)
        for ticks in range(6):
            move = asyncio.create_task(cell.robot.move(to(WORK + 0.6), timeout_s=30))
            for _ in range(ticks):
                await asyncio.sleep(0)
            move.cancel()
            with pytest.raises(asyncio.CancelledError):
                await move
            before = await cell.robot.read()
            await cell.camera.grab(exposed_after=cell.clock.now() + 0.5)
            after = await cell.robot.read()
            assert np.abs(after.joints - before.joints).max() < 1e-4  # the ring's end


async def test_a_move_that_takes_too_long_is_stopped(endpoint):
    async with devices(endpoint) as cell:
        await cell.robot.move(to(WORK), timeout_s=30)
        with pytest.raises(DeviceFault, match=r"no standstill within 0\.3 s; the arm was stopped"):
            await cell.robot.move(to(WORK + 0.6), timeout_s=0.3)
        assert (await cell.robot.read()).standstill_s >= STANDSTILL_S
        await cell.robot.move(to(WORK), timeout_s=30)


async def test_a_stop_by_somebody_else_is_noticed(paced):
    async with devices(paced) as cell, devices(paced) as other:
        await cell.robot.move(to(WORK), timeout_s=30)
        move = asyncio.create_task(cell.robot.move(to(WORK + 0.6), timeout_s=30))
        await asyncio.sleep(0.4)
        await other.robot.stop(clean=True)
        with pytest.raises(DeviceFault, match="something else stopped it"):
            await move


async def test_stop_is_idempotent(endpoint):
    async with devices(endpoint) as cell:
        for clean in (True, False, True):
            await cell.robot.stop(clean=clean)
        assert (await cell.robot.read()).standstill_s > 0


async def test_a_lost_link_is_a_fault_stops_the_arm_and_heals(paced):
    async with devices(paced) as cell:
        await cell.robot.move(to(WORK), timeout_s=30)
        move = asyncio.create_task(cell.robot.move(to(WORK + 0.6), timeout_s=30))
        await asyncio.sleep(0.4)
        await cell.faults.plant("robot.drop_link")
        with pytest.raises(DeviceFault, match="link to the simulated cell was lost"):
            await move
        await asyncio.sleep(0.5)
        state = await cell.robot.read()  # over a new connection
        assert state.standstill_s > 0
        assert np.abs(state.joints - WORK - 0.6).max() > 0.1
        await cell.robot.move(to(WORK), timeout_s=30)


async def test_a_motion_that_has_only_begun_is_no_standstill(endpoint):
    """The daemon dies in the very tick in which it asked for a motion: nothing measured yet."""
    async with devices(endpoint) as cell:
        await cell.robot.move(to(WORK), timeout_s=30)
        link = Link("daemon", endpoint.cell)
        await link.request(
            "robot.move",
            waypoints=[(WORK + 0.6).tolist()],
            joint_speed_rad_s=0.7,
            joint_acceleration_rad_s2=1.4,
            tool_speed_m_s=0.5,
        )
        state = await cell.robot.read()
        assert not state.speeds.any()
        assert state.standstill_s == 0.0
        await link.close()
        await cell.robot.stop(clean=True)
        await cell.robot.move(to(WORK), timeout_s=30)


async def test_the_arm_stops_when_the_daemon_goes_away(paced):
    async with devices(paced) as cell:
        await cell.robot.move(to(WORK), timeout_s=30)
        link = Link("daemon", paced.cell)
        await link.request(
            "robot.move",
            waypoints=[(WORK + 0.6).tolist()],
            joint_speed_rad_s=0.7,
            joint_acceleration_rad_s2=1.4,
            tool_speed_m_s=0.5,
        )
        await asyncio.sleep(0.3)
        await link.close()
        await asyncio.sleep(0.8)
        state = await cell.robot.read()
        assert state.standstill_s > 0
        assert np.abs(state.joints - WORK - 0.6).max() > 0.1


async def test_a_protective_stop_is_a_fault_until_a_person_clears_it(paced):
    async with devices(paced) as cell:
        await cell.robot.move(to(WORK), timeout_s=30)
        move = asyncio.create_task(cell.robot.move(to(WORK + 0.6), timeout_s=30))
        await asyncio.sleep(0.3)
        await cell.faults.plant("robot.protective_stop", reason="a test")
        with pytest.raises(DeviceFault, match="protective stop: a test"):
            await move
        with pytest.raises(DeviceFault, match="does not move: protective stop: a test"):
            await cell.robot.move(to(WORK), timeout_s=30)
        await cell.robot.stop(clean=True)  # works from any state
        await cell.faults.plant("robot.clear_fault")
        await cell.robot.move(to(WORK), timeout_s=30)


async def test_driving_into_the_table_is_counted(battered):
    async with devices(battered) as cell:
        await cell.robot.move(to(WORK), timeout_s=30)
        low = WORK - np.radians(40) * np.eye(6)[1]
        with pytest.raises(DeviceFault, match="touched table"):
            await cell.robot.move(to(low), timeout_s=30)
        (collision,) = await cell.scorer.collisions()
        assert "table" in collision["between"]


async def test_state_at_a_frame_s_time(endpoint):
    async with devices(endpoint) as cell:
        await cell.robot.move(to(WORK), timeout_s=30)
        began = cell.clock.now()
        await cell.robot.move(to(NEAR), timeout_s=30)
        middle = await cell.robot.state_at(began + 0.3)
        assert middle.t == began + 0.3
        assert middle.speeds.any()
        assert middle.standstill_s == 0
        assert 0.001 < np.abs(middle.joints - WORK).max() < np.abs(NEAR - WORK).max()
        frame = await cell.camera.grab(exposed_after=cell.clock.now())
        assert (await cell.robot.state_at(frame.t)).standstill_s >= STANDSTILL_S
        with pytest.raises(DeviceFault, match="the record covers"):
            await cell.robot.state_at(cell.clock.now() + 10)


async def test_grab_never_returns_a_stale_frame(either):
    async with devices(either) as cell:
        await cell.robot.read()
        raw = Link("raw", either.cell)
        old, _ = await raw.request("camera.dequeue", timeout_s=1.0)
        assert old["frame"]["t"] < old["t"] - 0.0167  # what a naive grab gets
        await raw.close()
        last = -1
        for _ in range(3):
            after = cell.clock.now()
            frame = await cell.camera.grab(exposed_after=after)
            assert frame.t >= after
            assert frame.sequence > last
            assert frame.image.shape == (1080, 1920)
            assert frame.exposure_s == pytest.approx(0.0167)
            last = frame.sequence


async def test_a_naive_show_and_grab_gets_the_old_picture(either):
    async with devices(either) as cell:
        await cell.camera.grab(exposed_after=await cell.projector.show(BLACK))
        shown = cell.clock.now()
        glass = await cell.projector.show(WHITE)
        naive = await cell.camera.grab(exposed_after=-1e9)
        patient = await cell.camera.grab(exposed_after=glass)
        await cell.projector.show(BLACK)
        assert glass - shown > 0.035 + 3 * 0.008
        assert patient.image.mean() > naive.image.mean() + 5


async def test_show_checks_the_image(endpoint):
    async with devices(endpoint) as cell:
        wrong: list[Any] = [
            np.zeros((100, 100), np.uint8),
            np.zeros((1080, 1920), np.float32),
            np.zeros((1080, 1920, 4), np.uint8),
        ]
        for image in wrong:
            with pytest.raises(BadInput, match="projector: an image is"):
                await cell.projector.show(image)
        await cell.projector.show(np.zeros((1080, 1920, 3), np.uint8))


async def test_a_camera_without_frames_is_a_fault(endpoint):
    async with devices(endpoint) as cell:
        await cell.faults.plant("camera.drop", frames=1000)
        with pytest.raises(DeviceFault, match="no frame that was exposed after"):
            await cell.camera.grab(exposed_after=cell.clock.now())
        await cell.faults.plant("camera.drop", frames=2)
        before = await cell.camera.grab(exposed_after=-1e9)
        assert before.sequence > 0


async def test_a_frozen_camera_repeats_its_picture_with_fresh_stamps(endpoint):
    async with devices(endpoint) as cell:
        await cell.robot.move(to(WORK), timeout_s=30)
        await cell.camera.grab(exposed_after=cell.clock.now() + 1.0)
        await cell.faults.plant("camera.freeze", seconds=5.0)
        first = await cell.camera.grab(exposed_after=cell.clock.now())
        await cell.robot.move(to(NEAR), timeout_s=30)
        second = await cell.camera.grab(exposed_after=cell.clock.now())
        assert second.t > first.t
        assert np.array_equal(first.image, second.image)
        third = await cell.camera.grab(exposed_after=first.t + 6.0)
        assert not np.array_equal(first.image, third.image)


async def test_a_nudged_camera_sees_the_cell_elsewhere(battered):
    async with devices(battered) as cell:
        before = await cell.camera.grab(exposed_after=cell.clock.now())
        pose = (await cell.scorer.read())["camera"]["T_world_camera"]
        await cell.faults.plant("nudge", device="camera", turn_deg=[0.0, 0.0, 2.0])
        after = await cell.camera.grab(exposed_after=cell.clock.now())
        assert (await cell.scorer.read())["camera"]["T_world_camera"] != pose
        alike = np.corrcoef(before.image.ravel(), after.image.ravel())[0, 1]
        assert alike < 0.98


async def test_a_dark_projector(endpoint):
    async with devices(endpoint) as cell:
        await cell.projector.show(WHITE)
        await cell.faults.plant("projector.off")
        dark = await cell.camera.grab(exposed_after=cell.clock.now() + 0.2)
        await cell.faults.plant("projector.on")
        lit = await cell.camera.grab(exposed_after=cell.clock.now() + 0.2)
        await cell.projector.show(BLACK)
        assert lit.image.mean() > dark.image.mean() + 5


async def test_a_late_answer_is_a_fault_and_is_not_taken_for_the_next(endpoint):
    async with devices(endpoint) as cell:
        link = Link("impatient", endpoint.cell)
        await link.request("hello")
        await cell.faults.plant("slow", seconds=0.5, count=1)
        with pytest.raises(DeviceFault, match=r"no answer to wait within 0\.1 s"):
            await link.request("wait", seconds=0.0, answer_s=0.1)
        reply, _ = await link.request("hello")
        assert reply["arm"] == "ur5"
        await link.close()


async def test_nobody_there_is_a_fault(endpoint):
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        gone = replace(endpoint, cell=unused.getsockname()[1])
    async with devices(gone) as cell:
        with pytest.raises(DeviceFault, match="does not answer on port"):
            await cell.robot.read()


async def record(endpoint):
    """What a fixed list of requests yields: joints and pictures."""
    found = []
    async with devices(endpoint) as cell:
        for name in ("a", ""):
            token = SAMPLE.set(name)
            state = await cell.robot.move(to(NEAR if name else WORK), timeout_s=30)
            glass = await cell.projector.show(WHITE if name else BLACK)
            frame = await cell.camera.grab(exposed_after=max(glass, state.t + RING_S))
            found += [state.joints, frame.image, np.array([frame.t, cell.clock.now()])]
            SAMPLE.reset(token)
    return found


async def test_the_same_requests_give_the_same_bytes_in_another_process(tmp_path):
    runs = []
    for i in range(2):
        with world(tmp_path / f"{i}", seed=5) as running:
            runs.append(await record(running))
    for one, two in zip(*runs, strict=True):
        assert np.array_equal(one, two)
    assert not np.array_equal(runs[0][1], runs[0][4])


async def test_a_sample_taken_again_after_a_crash_is_the_same_sample(endpoint):
    async def take(cell, name, via):
        await cell.robot.move(to(via), timeout_s=30)
        token = SAMPLE.set(name)
        state = await cell.robot.move(to(WORK), timeout_s=30)
        pictures = []
        for _ in range(2):
            frame = await cell.camera.grab(exposed_after=state.t + RING_S)
            pictures.append(frame.image)
        SAMPLE.reset(token)
        await cell.robot.read()
        return [(await cell.robot.state_at(frame.t)).joints, *pictures]

    async with devices(endpoint) as cell:
        await cell.projector.show(BLACK)
        first = await take(cell, "hand-eye/3", NEAR)
    async with devices(endpoint) as cell:  # the daemon was killed and came back
        await take(cell, "hand-eye/2", NEAR)
        again = await take(cell, "hand-eye/3", WORK + 0.05)
    for one, two in zip(first, again, strict=True):
        assert np.array_equal(one, two)
    assert not np.array_equal(first[1], first[2])


async def test_paced_time_is_real_time(paced):
    async with devices(paced) as cell:
        await cell.robot.move(to(WORK), timeout_s=30)
        assert cell.clock.now() == pytest.approx(time.monotonic(), abs=0.1)
        began = time.monotonic()
        await cell.robot.move(to(WORK + 0.3 * np.eye(6)[0]), timeout_s=30)
        took = time.monotonic() - began
        at_least = 0.3 / np.radians(40) + np.radians(40) / np.radians(80)
        assert at_least < took < at_least + 1.5
        frames = [await cell.camera.grab(exposed_after=cell.clock.now()) for _ in range(2)]
        assert abs(frames[1].t - time.monotonic()) < 2.0


async def test_time_and_other_devices_go_on_while_a_picture_is_rendered(paced):
    async with devices(paced) as cell:
        await cell.robot.move(to(WORK), timeout_s=30)
        move = asyncio.create_task(cell.robot.move(to(WORK + 0.4), timeout_s=30))
        await asyncio.sleep(0.4)
        moving = cell.clock.now()
        grab = asyncio.create_task(cell.camera.grab(exposed_after=moving))
        reads, watcher = [], Link("watcher", paced.cell)
        while not grab.done():
            reads.append((await watcher.request("robot.read"))[0]["at"])
            await asyncio.sleep(0.01)
        await watcher.close()
        assert len(reads) > 5
        assert reads[-1] > reads[0] + 0.05
        await grab
        await move


async def test_stepped_time_passes_only_while_somebody_waits(endpoint):
    async with devices(endpoint) as cell:
        before = (await cell.robot.read(), cell.clock.now())[1]
        await asyncio.sleep(0.2)
        await cell.robot.read()
        assert cell.clock.now() == before
        began = time.monotonic()
        link = Link("waiter", endpoint.cell, cell.clock)
        await link.request("wait", seconds=100.0)
        await link.close()
        assert cell.clock.now() == before + 100.0
        assert time.monotonic() - began < 2.0
