"""The whole product on the simulated cell, from outside: daemon, bus, world, record."""

from __future__ import annotations

import asyncio
import json
import time

import numpy as np
import pytest

from cellctl.calib.calibration import Calibration
from cellctl.demo import score
from cellctl.offline import solve_folder
from tests.integration.cellrun import QUICK, cell_run
from tests.soak.kill import differences, killed


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """A quick `full` that ran undisturbed, and its cell, still alive."""
    folder = tmp_path_factory.mktemp("cell")
    with cell_run(folder) as cell:
        with cell.client() as client:
            run_id = client.run("full", QUICK).run_id
        yield cell, cell.finish(run_id)


def test_it_calibrates_alone(done):
    cell, info = done
    assert info.status == "done", cell.log()
    assert info.verdict == "pass", info.reasons
    with cell.client() as client:
        document = client.calibration(info.calibration_id).document
    calibration = Calibration.from_dict(document["calibration"])
    scored = asyncio.run(score(info, calibration, cell.folder))
    assert scored["final"]["true_mm"] < 1.0
    assert scored["collisions"] == 0


def test_solved_again_offline_it_is_the_online_result(done):
    cell, info = done
    again = solve_folder(cell.folder / "runs" / info.run_id)
    online = cell.result(info.run_id)
    assert again["verdict"] == online["verdict"]
    assert {key: again[key] for key in online["data"]} == online["data"]


def test_pictures_and_poses_are_on_disk(done):
    cell, info = done
    folder = cell.folder / "runs" / info.run_id
    lines = [json.loads(line) for line in cell.journal(info.run_id)]
    samples = [line for line in lines if line["kind"] == "sample"]
    named = [image["file"] for line in samples for image in line["data"]["images"].values()]
    assert len(samples) == info.samples
    assert len(named) >= 8 + 5 + 1
    assert all((folder / name).is_file() for name in named)


def test_killed_and_resumed_it_ends_with_the_same_result(done, tmp_path):
    cell, info = done
    with cell_run(tmp_path) as other:
        run_id, interrupted, wrong = killed(other, [5.0, 11.0])
        assert (interrupted, wrong) == (2, [])
        assert other.finish(run_id).status == "done", other.log()
        assert differences(other, run_id, cell.result(info.run_id)) == []


def samples_and_motion(cell, client, run_id):
    """Wait until the run has a sample and the arm moves."""
    end = time.monotonic() + 60
    while time.monotonic() < end:
        if client.run_info(run_id).samples and np.abs(asyncio.run(cell.arm()).speeds).max() > 0.1:
            return
    raise AssertionError(f"no motion after a sample:\n{cell.log()}")


def stands_still(state):
    assert state.standstill_s > 0
    assert not state.speeds.any()


def test_sigterm_interrupts_the_run_and_ends_cleanly(tmp_path):
    with cell_run(tmp_path) as cell:
        with cell.client() as client:
            run_id = client.run("intrinsic", QUICK["intrinsic"]).run_id
            samples_and_motion(cell, client, run_id)
        assert cell.terminate() == 0, cell.log()
        stands_still(asyncio.run(cell.arm()))
        cell.start()
        with cell.client() as client:
            assert client.run_info(run_id).status == "interrupted"
            assert client.state().phase == "idle"
            client.resume(run_id)
        assert cell.finish(run_id).status == "done"
