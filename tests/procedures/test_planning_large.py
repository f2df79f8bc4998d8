"""Planning where the camera hangs far above what the arm can reach: views adapt to that."""

from __future__ import annotations

import numpy as np
import pytest

from cellctl import ik
from cellctl.calib.intrinsic import IntrinsicLimits
from cellctl.config import parse_config
from cellctl.geometry import pose_matrix
from cellctl.motion import guard_of
from cellctl.procedures import hand_eye, intrinsic, parking, planning
from cellctl.procedures.knowledge import known
from cellctl.procedures.sweep import SEARCH_EDGE
from cellctl.sim.cell_config import cell_document
from cellctl.sim.presets import CR, IR
from tests import cells

HOME = np.radians(IR.home_deg)
SWEEPS = {
    intrinsic.BOARD: lambda config: intrinsic.sweep_of(config, intrinsic.IntrinsicParams()),
    hand_eye.BOARD: lambda config: hand_eye.sweep_of(config, hand_eye.HandEyeParams()),
}
LEAST_SQUARE_PX = 25.0


def prepared(config, board):
    """Guard, rig and sweep of a board that is held as the tape says."""
    sweep = SWEEPS[board](config)
    rig = known(config, None).belief(config, board).rig(sweep.board)
    return guard_of(config), rig, sweep


@pytest.fixture(params=[0, 1])
def config(request):
    return parse_config(cell_document(IR, request.param), "generated")


@pytest.mark.parametrize("board", SWEEPS)
def test_there_are_views_that_can_be_read(config, board):
    guard, rig, sweep = prepared(config, board)
    views = planning.plan_sweep(rig, guard, HOME, sweep.spread, 6, seed=0)
    assert len(views) >= 6
    assert guard.free(np.array([view.joints for view in views])).all()
    assert planning.reach(guard, HOME, views[0].joints[None], np.empty((0, 6))) is not None
    depth = max(view.T_camera_board[2, 3] for view in views)
    square = IR.boards.square_m if board == intrinsic.BOARD else IR.boards.marker_m
    assert rig.camera.K[0, 0] * square / depth > LEAST_SQUARE_PX


@pytest.mark.parametrize("board", SWEEPS)
def test_there_are_views_to_search_in(config, board):
    guard, rig, _ = prepared(config, board)
    edge = SEARCH_EDGE * rig.camera.image_size[0]
    views = planning.search_views(rig, guard, HOME, 0, np.empty((0, 4, 4)), edge, seed=0)
    assert len(views) > planning.CONNECT_TRIES


def test_parking_leaves_the_light_and_the_cameras_view_of_it(config):
    """From a posture with the boards high over the table."""
    guard = guard_of(config)
    boards_up = pose_matrix((0.0, 0.0, 0.0), (1.0, 0.0, 1.8))
    found = ik.solutions(guard.arm, boards_up[None], HOME, ik.random_starts(guard.arm, 20, 0))[0]
    here = found[guard.free(found)][0]
    beams = parking.beams(config, known(config, None).T_world_camera)
    assert parking.clearance(guard, beams, here[None])[0] < 0.0
    path = parking.way_out(guard, beams, here, np.empty((0, 6)), 0.15, seed=0)
    assert path is not None
    guard.check(here, path)
    assert parking.clearance(guard, beams, path.waypoints[-1:])[0] >= 0.15


@pytest.mark.parametrize("board", SWEEPS)
def test_what_the_arm_can_come_near_to_is_left_as_it_is(board):
    for config in (cells.config(), parse_config(cell_document(CR, 0), "generated")):
        guard, rig, sweep = prepared(config, board)
        assert planning.attainable(sweep.spread, rig, guard) is sweep.spread


@pytest.mark.parametrize("board", SWEEPS)
def test_far_below_the_camera_boards_are_smaller_and_nearer_to_the_middle(config, board):
    guard, rig, sweep = prepared(config, board)
    scaled = planning.attainable(sweep.spread, rig, guard)
    assert scaled.fill[1] < 0.5 * sweep.spread.fill[1]
    assert scaled.fill[1] / scaled.fill[0] == pytest.approx(
        sweep.spread.fill[1] / sweep.spread.fill[0]
    )
    assert (scaled.middle < 0.5) == (board == hand_eye.BOARD)
    assert not scaled.about_camera


@pytest.mark.parametrize("seed", range(4))
def test_a_camera_that_sees_beyond_the_light_need_not_be_covered_there(seed):
    """Twice what the light takes of the picture: 16 % in the large cell, by tape; in the small
    one, which light fills by a quarter, the usual limit."""
    small, large = (parse_config(cell_document(p, seed), "generated") for p in (CR, IR))
    assert intrinsic.needed_coverage(small) == IntrinsicLimits.coverage
    assert intrinsic.needed_coverage(large) == pytest.approx(0.16, abs=0.02)
