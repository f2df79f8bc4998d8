"""What goes wrong in a cell, planted in the world: each is named, nothing wrong is recorded, and
the run can go on. The daemon runs in this process, the world in its own."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import uuid

import numpy as np
import pytest

from cellctl.bus.server import Server
from cellctl.bus.session import free_endpoint
from cellctl.config import parse_config
from cellctl.daemon import serve
from cellctl.errors import DeviceFault, NotEnabled
from cellctl.messages import AckRequest, CancelRequest, ResumeRequest, RunRequest
from cellctl.permission import enable
from cellctl.sim.cell_config import cell_document
from cellctl.sim.drivers import SimRobot
from cellctl.sim.endpoint import read_endpoint
from cellctl.sim.launch import endpoint_file, stop_world
from cellctl.sim.presets import PRESETS
from cellctl.sim.scoring import FaultPlanter

ONE_PICTURE = {"columns": 10, "rows": 6, "pictures": 1}
END_S = 120.0


class Planted:
    """An engine on a simulated cell, and the door through which faults are planted."""

    def __init__(self, engine, planter, folder):
        self.engine, self.planter, self.folder = engine, planter, folder
        self._news = asyncio.Event()
        engine.subscribe(lambda _: self._news.set())

    async def start(self, procedure, **params):
        request = RunRequest(request_id=uuid.uuid4().hex, params=params)
        return (await self.engine.start(procedure, request)).run_id

    async def until(self, condition):
        """Wait until `condition(state)` holds."""
        async with asyncio.timeout(END_S):
            while not condition(self.engine.state()):
                self._news.clear()
                await self._news.wait()

    async def sampled(self, count):
        await self.until(lambda s: s.progress is not None and s.progress.done >= count)

    async def ended(self, run_id):
        await self.until(lambda s: s.active_run is None)
        return await self.engine.run_info(run_id)


@contextlib.asynccontextmanager
async def cell(folder, seed=0, **changes):
    """`changes` are sections of the config to update."""
    document = cell_document(PRESETS["cr"], seed)
    document["bus"] = {"listen": free_endpoint()}
    document["cell"]["data_dir"] = str(folder)
    for section, values in changes.items():
        document[section].update(values)
    config = parse_config(document, "test")
    try:
        async with serve(config) as engine:
            planter = FaultPlanter(read_endpoint(endpoint_file(folder)))
            try:
                yield Planted(engine, planter, folder)
            finally:
                await planter.close()
    finally:
        await asyncio.to_thread(stop_world, folder)


async def test_camera_that_was_bumped_fails_the_verdict(tmp_path):
    async with cell(tmp_path) as planted:
        run_id = await planted.start("projector", columns=10, rows=6, pictures=4)
        await planted.sampled(3)
        await planted.planter.plant("nudge", device="camera", shift_mm=[0.5, 0.0, 0.0])
        info = await planted.ended(run_id)
    assert info.status == "done"
    assert info.verdict == "fail"
    assert any("was touched" in reason for reason in info.reasons)


async def test_protective_stop_waits_for_a_person_and_goes_on(tmp_path):
    async with cell(tmp_path) as planted:
        run_id = await planted.start("intrinsic", views=6)
        await planted.sampled(1)
        await planted.planter.plant("robot.protective_stop")
        info = await planted.ended(run_id)
        assert info.status == "interrupted"
        assert "protective stop" in planted.engine.state().fault
        with pytest.raises(DeviceFault, match="protective stop"):
            await planted.engine.resume(ResumeRequest(run_id=run_id))
        before = info.samples
        await planted.planter.plant("robot.clear_fault")
        await planted.engine.ack(AckRequest())
        await planted.engine.resume(ResumeRequest(run_id=run_id))
        info = await planted.ended(run_id)
        assert info.status == "done", info.error
        assert info.samples > before


async def test_frozen_camera_never_passes(tmp_path):
    """Fresh time stamps, an old picture: the markers that are shown are not in it."""
    async with cell(tmp_path) as planted:
        await planted.planter.plant("camera.freeze", seconds=100.0)
        info = await planted.ended(await planted.start("projector", **ONE_PICTURE))
        assert (info.status, info.verdict) == ("done", "fail")
        assert any("only 0 projected markers were found" in reason for reason in info.reasons)


async def test_dropped_frames_do_no_harm(tmp_path):
    async with cell(tmp_path) as planted:
        await planted.planter.plant("camera.drop", frames=7)
        info = await planted.ended(await planted.start("projector", **ONE_PICTURE))
        assert info.verdict == "pass", info.error or info.reasons


async def test_dark_projector_is_named(tmp_path):
    async with cell(tmp_path) as planted:
        await planted.planter.plant("projector.off")
        info = await planted.ended(await planted.start("projector", **ONE_PICTURE))
        assert (info.status, info.verdict) == ("done", "fail")
        assert any("is the projector on" in reason for reason in info.reasons)


async def test_too_short_a_latency_does_no_harm(tmp_path):
    """Pictures of the glass before and while it changes come first: none of them is recorded."""
    async with cell(tmp_path, projector={"latency_s": 0.0}) as planted:
        run_id = await planted.start("projector", columns=10, rows=6, pictures=4)
        info = await planted.ended(run_id)
        assert info.status == "done", info.error
        # A picture that was still changing would spoil most markers; a sheet's edges spoil two.
        assert info.result["data"]["held_out_used_px"] < 0.3
        assert len(info.result["data"]["markers"]["rejected"]) <= 2


async def test_world_that_dies_is_a_fault_not_a_hang(tmp_path):
    async with cell(tmp_path) as planted:
        run_id = await planted.start("intrinsic", views=6)
        await planted.sampled(1)
        os.kill(read_endpoint(endpoint_file(tmp_path)).pid, signal.SIGKILL)
        info = await planted.ended(run_id)
        assert info.status == "interrupted"
        assert planted.engine.state().fault


async def test_nothing_moves_without_permission(tmp_path):
    async with cell(tmp_path, cell={"motion_enabled": False}) as planted:
        with pytest.raises(NotEnabled, match="cellctl enable"):
            await planted.start("projector", **ONE_PICTURE)
        assert (await planted.engine.runs()).runs == []
        enable(tmp_path, 600.0)
        info = await planted.ended(await planted.start("projector", **ONE_PICTURE))
        assert info.status == "done", info.error


async def test_cancel_stops_the_arm(tmp_path, monkeypatch):
    """In the middle of a motion: fast, and far from where it was going to."""
    goals = []
    start = SimRobot._start

    async def noted(self, target):
        goals.append(target.path.waypoints[-1])
        await start(self, target)

    monkeypatch.setattr(SimRobot, "_start", noted)
    async with cell(tmp_path) as planted:
        run_id = await planted.start("intrinsic", views=6)
        await planted.sampled(1)
        robot = planted.engine._cell.robot
        async with asyncio.timeout(END_S):
            while True:
                state = await robot.read()
                if (
                    np.abs(state.speeds).max() > 0.3
                    and np.abs(state.joints - goals[-1]).max() > 0.3
                ):
                    break
        await planted.engine.cancel(CancelRequest())
        info = await planted.ended(run_id)
        assert info.status == "cancelled"
        assert planted.engine.state().phase == "idle"
        stopped = await robot.read()
        assert stopped.standstill_s > 0
        assert not stopped.speeds.any()
        assert np.abs(stopped.joints - goals[-1]).max() > 0.1
        assert np.abs(stopped.joints - state.joints).max() < 0.5, "it braked"


async def test_the_solver_is_ready_before_the_cell_says_that_it_is_alive(tmp_path, monkeypatch):
    opened, pids = Server.open, []

    async def noted(self):
        pids.append(self._engine._cell.solver.pid)
        await opened(self)

    monkeypatch.setattr(Server, "open", noted)
    async with cell(tmp_path) as planted:
        assert pids == [planted.engine._cell.solver.pid] != [None]


async def test_a_board_that_is_not_there_ends_the_search(tmp_path):
    """The config says a board of another size: it is never found, and the run says so."""
    checkerboard = cell_document(PRESETS["cr"], 0)["bracket"]["checkerboard"]
    checkerboard["board"] |= {"inner_corners": [8, 5]}
    async with cell(tmp_path, bracket={"checkerboard": checkerboard}) as planted:
        info = await planted.ended(await planted.start("intrinsic", views=6, search=3))
        assert info.status == "failed"
        assert "the board was not found in 3 poses" in info.error
