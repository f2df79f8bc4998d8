"""Drawing and touching through the drivers and the doors, against a world process."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest

from cellctl.drivers.base import SAMPLE, Stroke
from cellctl.errors import BadInput, DeviceFault, MotionRefused, NotFound
from cellctl.sim.drivers import GOAL_RAD, STANDSTILL_S, SimRobot
from cellctl.sim.grid import touched_height
from cellctl.sim.link import Link, SimClock
from cellctl.sim.presets import CR
from cellctl.sim.truth import draw
from tests.sim.strokes import RADIUS_M, SPOT, circle_tips, joints_at, tips_of
from tests.sim.worlds import config, devices, to, world

SEED = 0
TRUTH = draw(CR, SEED)
CIRCLE = joints_at(TRUTH, circle_tips(TRUTH))
ABOUT_M = 2 * np.pi * RADIUS_M


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory):
    with world(tmp_path_factory.mktemp("stepped"), seed=SEED) as running:
        yield running


@pytest.fixture(scope="module")
def paced(tmp_path_factory):
    with world(tmp_path_factory.mktemp("paced"), seed=SEED, time="paced") as running:
        yield running


def stroke(joints=CIRCLE, speed=0.05):
    return Stroke(joints[1:], speed)


def falling(spot=SPOT, to_m=-4e-3):
    height = touched_height(TRUTH)
    fall = np.arange(height + 5e-3, height + to_m, -0.5e-3)
    return joints_at(TRUTH, np.column_stack([np.tile(spot, (len(fall), 1)), fall]))


async def test_a_stroke_is_drawn_measured_and_left_standing(endpoint):
    async with devices(endpoint) as cell:
        await cell.faults.plant("sheet.replace")
        await cell.robot.move(to(CIRCLE[0]), timeout_s=30)
        result = await cell.robot.draw(stroke(), timeout_s=60)
        assert result.state.standstill_s >= STANDSTILL_S
        assert np.abs(result.state.joints - CIRCLE[-1]).max() < GOAL_RAD
        assert np.diff(result.t) == pytest.approx(0.008)
        assert np.abs(result.joints[0] - CIRCLE[0]).max() < GOAL_RAD
        assert np.abs(result.joints[-1] - CIRCLE[-1]).max() < GOAL_RAD
        tips = tips_of(TRUTH, result.joints)
        low = tips[tips[:, 2] < tips[:, 2].min() + 0.5e-3, :2]
        assert np.linalg.norm(low - SPOT, axis=1) == pytest.approx(RADIUS_M, abs=0.3e-3)
        (drawn,) = await cell.scorer.ink()
        assert drawn["sheet"] == "A"
        assert drawn["radius_m"] == pytest.approx(RADIUS_M, abs=0.1e-3)
        assert drawn["length_m"] == pytest.approx(ABOUT_M, rel=0.02)
        assert np.linalg.norm(np.array(drawn["centre_m"])[:2] - SPOT) < 6e-3
        assert await cell.scorer.collisions() == []


async def test_the_same_sample_is_the_same_circle(endpoint):
    async with devices(endpoint) as cell:
        found = []
        for name in ("a", "b", "a"):
            await cell.faults.plant("sheet.replace", sheet="A")
            token = SAMPLE.set(f"draw/{name}")
            await cell.robot.move(to(CIRCLE[0]), timeout_s=30)
            await cell.robot.draw(stroke(), timeout_s=60)
            SAMPLE.reset(token)
            await cell.robot.read()
            found.append((await cell.scorer.ink())[0]["centre_m"])
            await cell.robot.move(to(CIRCLE[0] + 0.01), timeout_s=30)
        assert found[0] == pytest.approx(found[2], abs=1e-9)
        assert np.abs(np.subtract(found[0], found[1])).max() > 1e-6


async def test_a_circle_is_seen_by_the_camera(endpoint):
    async with devices(endpoint) as cell:
        home = np.radians(CR.home_deg)
        await cell.faults.plant("sheet.replace")
        pictures = []
        for draws in (False, True):
            if draws:
                await cell.robot.move(to(CIRCLE[0]), timeout_s=30)
                await cell.robot.draw(stroke(), timeout_s=60)
                centre = np.array((await cell.scorer.ink())[-1]["centre_m"])
            state = await cell.robot.move(to(home), timeout_s=30)
            pictures.append((await cell.camera.grab(exposed_after=state.t + 0.5)).image.astype(int))
        darker = pictures[0] - pictures[1] > 12
        rows, columns = np.nonzero(darker)
        expected = TRUTH.camera.project(centre)
        assert 80 < len(rows) < 800
        assert (np.median(columns), np.median(rows)) == pytest.approx(tuple(expected), abs=4)


async def test_a_touch_stands_where_it_felt_the_paper(endpoint):
    async with devices(endpoint) as cell:
        joints = falling()
        await cell.robot.move(to(joints[0]), timeout_s=30)
        state = await cell.robot.touch(Stroke(joints[1:], 0.01), timeout_s=30)
        stands = await cell.robot.read()
        assert stands.standstill_s >= STANDSTILL_S
        felt, rests = tips_of(TRUTH, np.array([state.joints, stands.joints]))
        assert np.linalg.norm(felt - rests) < 0.5e-3
        # Where the true tip then is: the pen is pushed in by the switch's 0.2 mm.
        true = np.array((await cell.scorer.read())["T_world_flange"])
        tip = true[:3, :3] @ TRUTH.pen + true[:3, 3]
        surface = TRUTH.table.hit(tip, true[None, :3, 2])[0]
        assert 0.1e-3 < surface[2] - tip[2] < 0.6e-3
        await cell.robot.move(to(joints[0]), timeout_s=30)
        with pytest.raises(DeviceFault, match="no contact was felt"):
            await cell.robot.touch(Stroke(joints[1:4], 0.01), timeout_s=30)


async def test_a_pen_that_cannot_feel_says_so(endpoint):
    cell_config = config()
    pen = cell_config.bracket.pen.model_copy(update={"feels_contact": False})
    bracket = cell_config.bracket.model_copy(update={"pen": pen})
    blind = cell_config.model_copy(update={"bracket": bracket})
    robot = SimRobot(endpoint, blind, SimClock("stepped"))
    before = await robot.read()
    with pytest.raises(DeviceFault, match="cannot feel a contact"):
        await robot.touch(stroke(), timeout_s=30)
    assert np.array_equal((await robot.read()).joints, before.joints)
    await robot.close()


async def test_what_cannot_be_followed_moves_nothing(endpoint):
    async with devices(endpoint) as cell:
        before = await cell.robot.move(to(CIRCLE[0]), timeout_s=30)
        for joints, error, match in (
            (CIRCLE[20:], MotionRefused, "mm of the tip from where the pen is"),
            (CIRCLE + 20.0, MotionRefused, "outside the joint limits"),
            (np.zeros((5001, 6)), BadInput, "joints"),
        ):
            with pytest.raises(error, match=match):
                await cell.robot.draw(Stroke(joints, 0.02), timeout_s=30)
        assert np.array_equal((await cell.robot.read()).joints, before.joints)


async def test_a_pen_pressed_too_far_is_a_fault(endpoint):
    deep = joints_at(TRUTH, circle_tips(TRUTH, push=9e-3))
    async with devices(endpoint) as cell:
        await cell.robot.move(to(CIRCLE[0]), timeout_s=30)
        with pytest.raises(DeviceFault, match="the pen holder is at the end of its travel"):
            await cell.robot.draw(stroke(deep), timeout_s=60)
        (collision,) = await cell.scorer.collisions()
        assert collision["between"] == ["pen", "table"]
        await cell.faults.plant("robot.clear_fault")
        await cell.faults.plant("pendant.jog", joints=CIRCLE[0].tolist())
        assert np.abs((await cell.robot.read()).joints - CIRCLE[0]).max() < GOAL_RAD


async def test_a_stroke_that_takes_too_long_is_stopped(endpoint):
    async with devices(endpoint) as cell:
        await cell.robot.move(to(CIRCLE[0]), timeout_s=30)
        with pytest.raises(DeviceFault, match="the arm was stopped"):
            await cell.robot.draw(stroke(speed=0.01), timeout_s=2.0)
        assert (await cell.robot.read()).standstill_s >= STANDSTILL_S


@pytest.mark.parametrize("how", ["cancelled", "link lost"])
async def test_half_a_circle_is_left_when_the_daemon_goes(paced, how):
    async with devices(paced) as cell:
        await cell.faults.plant("sheet.replace")
        await cell.robot.move(to(CIRCLE[0]), timeout_s=30)
        drawing = asyncio.create_task(cell.robot.draw(stroke(speed=0.03), timeout_s=60))
        link = Link("watcher", paced.cell)
        while not any(part["length_m"] > 0.02 for part in await cell.scorer.ink()):
            await link.request("wait", seconds=0.05)
        await link.close()
        if how == "cancelled":
            drawing.cancel()
            with pytest.raises(asyncio.CancelledError):
                await drawing
        else:
            await cell.faults.plant("robot.drop_link")
            with pytest.raises(DeviceFault, match="link to the simulated cell was lost"):
                await drawing
            await asyncio.sleep(0.7)
    async with devices(paced) as cell:  # the daemon came back
        assert (await cell.robot.read()).standstill_s > 0
        (drawn,) = await cell.scorer.ink()
        assert 0.02 < drawn["length_m"] < 0.9 * ABOUT_M
        state = await cell.robot.read()
        up = state.joints + np.radians([0, 3.0, 0, 0, 0, 0])
        await cell.robot.move(to(up), timeout_s=30)


async def test_a_person_places_the_pen(endpoint):
    point = TRUTH.table.surface(np.array([-0.1, 0.05]))
    async with devices(endpoint) as cell:
        await cell.faults.plant("pendant.place", point=point.tolist(), rpy_deg=[180.0, 0.0, 30.0])
        flange = np.array((await cell.scorer.read())["T_world_flange"])
        tip = flange[:3, :3] @ TRUTH.pen + flange[:3, 3]
        assert np.linalg.norm(tip - point) < 0.6e-3
        with pytest.raises(MotionRefused, match="does not reach"):
            await cell.faults.plant("pendant.place", point=[5.0, 0, 0], rpy_deg=[180.0, 0, 0])
        await cell.faults.plant("pendant.jog", joints=CIRCLE[0].tolist())


async def test_planted_faults_hit_at_their_stroke(tmp_path):
    with world(tmp_path, seed=SEED) as running:
        async with devices(running) as cell:
            plant = cell.faults.plant
            await plant("pen.slip", shift_mm=[3.0, 0.0, 0.0], after_strokes=1)
            await plant("pen.weak", share=0.5, count=1, after_strokes=2)
            await plant("drawing.shrink", factor=0.8, after_strokes=3)
            await plant("pen.dry", after_strokes=4)
            await plant("sheet.move", sheet="A", shift_mm=[10.0, 0.0], after_strokes=5)
            for _ in range(5):
                await cell.robot.move(to(CIRCLE[0]), timeout_s=30)
                await cell.robot.draw(stroke(), timeout_s=60)
            first, slipped, weak, small = await cell.scorer.ink()
            await cell.robot.move(to(CIRCLE[0]), timeout_s=30)
            moved = (await cell.scorer.ink())[0]
            await plant("pen.off", shift_mm=[6.0, 0.0, 0.0])
            await plant("sheet.print", sheet="A")
            assert await cell.scorer.ink() == []
            for verb in ("sheet.move", "sheet.replace", "sheet.print"):
                with pytest.raises(NotFound, match="no sheet 'Z' lies on the table; there are: A"):
                    await plant(verb, sheet="Z")
            assert (await cell.scorer.read())["pen"]["tip_m"][0] == pytest.approx(
                TRUTH.pen[0] + 9e-3
            )
    shift = np.linalg.norm(np.subtract(slipped["centre_m"], first["centre_m"]))
    assert shift == pytest.approx(3e-3, abs=0.8e-3)
    assert weak["length_m"] == pytest.approx(0.5 * ABOUT_M, rel=0.05)
    assert small["radius_m"] == pytest.approx(0.8 * RADIUS_M, rel=0.02)
    assert moved["centre_m"][0] - first["centre_m"][0] == pytest.approx(0.01, abs=1e-4)
