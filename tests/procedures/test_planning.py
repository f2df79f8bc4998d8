"""Planned views: in the picture, allowed, unhidden, spread out; parking leaves the light free."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from cellctl.calib.camera import CameraModel
from cellctl.drivers.base import Path
from cellctl.geometry import invert, transform_points
from cellctl.motion import guard_of
from cellctl.procedures import parking, planning
from cellctl.procedures.intrinsic import IntrinsicParams, sweep_of
from cellctl.procedures.knowledge import known
from cellctl.procedures.rig import Rig
from tests import cells
from tests.postures import free_pen_at

NOWHERE = np.empty((0, 6))


@pytest.fixture(scope="module")
def config():
    return cells.config()


@pytest.fixture(scope="module")
def guard(config):
    return guard_of(config)


@pytest.fixture(scope="module")
def here(guard):
    return free_pen_at(guard, 0.0, -0.45, 0.2)


@pytest.fixture(scope="module")
def rig(config):
    sweep = sweep_of(config, IntrinsicParams())
    return known(config, None).belief(config, "checkerboard").rig(sweep.board)


@pytest.fixture(scope="module")
def views(rig, guard, here):
    return planning.plan_sweep(rig, guard, here, planning.Spread(), 12, seed=0)


def poses(views):
    return np.array([view.T_camera_board for view in views])


def test_there_are_views_and_spares(views):
    assert len(views) > 12


def test_joints_show_the_board_where_planned(rig, guard, views):
    flange = guard.arm.forward(np.array([view.joints for view in views]))
    shown = invert(rig.T_world_camera) @ flange @ rig.T_flange_board
    assert np.allclose(shown, poses(views), atol=1e-5)


def test_every_view_is_allowed_and_in_the_picture(rig, guard, views):
    assert guard.free(np.array([view.joints for view in views])).all()
    pixels = rig.camera.project(rig.board_points(poses(views), 5))
    assert (pixels > 0).all()
    assert (pixels < np.array(rig.camera.image_size)).all()


def test_tilts_are_what_was_asked_for(views):
    tilt = np.degrees(np.arccos(poses(views)[:, 2, 2]))
    assert tilt.min() >= 20.0 - 1e-6
    assert tilt.max() <= 45.0 + 1e-6


def test_views_are_spread_out(rig, views):
    """Both sides of the picture, near and far, tilted to all four sides."""
    main = poses(views)[:12]
    middle = rig.camera.project(rig.board_points(main).mean(axis=1))
    assert np.ptp(middle[:, 0]) > 0.35 * rig.camera.image_size[0]
    assert np.ptp(np.log(main[:, 2, 3])) > 0.3
    assert (main[:, :2, 2].min(axis=0) < -0.15).all()
    assert (main[:, :2, 2].max(axis=0) > 0.15).all()


def test_corners_of_the_picture_are_filled(rig, guard, here):
    """Thirty views of the checkerboard come near to all four corners; distortion shows there."""
    sweep = sweep_of(cells.config(), IntrinsicParams())
    views = planning.plan_sweep(rig, guard, here, sweep.spread, sweep.count, sweep.seed)
    seen = rig.camera.project(rig.board_points(poses(views[: sweep.count]))).reshape(-1, 2)
    width, height = rig.camera.image_size
    for corner in ((0, 0), (width, 0), (0, height), (width, height)):
        assert np.linalg.norm(seen - corner, axis=1).min() < 0.15 * width


def test_what_a_cautious_guard_allows_is_allowed_from_a_little_beside(guard, here, views):
    hubs = np.array([view.joints for view in views])
    rng = np.random.default_rng(0)
    for view in views[:8]:
        path = planning.reach(guard, here, view.joints[None], hubs)
        assert path is not None
        for _ in range(5):
            guard.check(here + rng.uniform(-1e-3, 1e-3, 6), path)
        here = view.joints


def test_the_same_plan_every_time(rig, guard, here, views):
    again = planning.plan_sweep(rig, guard, here, planning.Spread(), 12, seed=0)
    assert np.array_equal(poses(again), poses(views))


def test_all_views_can_be_reached_in_order(guard, here, views):
    hubs = np.array([view.joints for view in views])
    for view in views[:12]:
        path = planning.reach(guard, here, view.joints[None], hubs)
        assert path is not None
        guard.check(here, path)
        here = view.joints


def test_where_no_other_way_leads_out_the_arm_goes_back(guard, here, views):
    """Over the postures that it came by, as far as a straight line leads to the goal."""
    came = np.array([view.joints for view in views[:12]])
    ways = [planning.reach(guard, a, b[None], came) for a, b in itertools.pairwise(came)]
    gone = np.vstack([came[:1], *(way.waypoints for way in ways if way is not None)])
    path = planning.retrace(guard, gone[-1], came[0], gone)
    assert path is not None
    guard.check(gone[-1], path)
    assert np.array_equal(path.waypoints[-1], came[0])
    assert planning.retrace(guard, gone[-1], came[0] + 9.0, gone) is None


def test_an_arm_before_the_camera_hides_the_board(rig, guard, views):
    """Turn the picture round: from behind the arm, nothing is free to see."""
    view = views[0]
    assert planning.unhidden(rig, guard, poses([view]), view.joints[None])[0]
    elbow = guard.spheres(view.joints)[0][0].mean(axis=0)
    board = transform_points(rig.T_world_camera, rig.board_points(poses([view]))[0].mean(axis=0))
    behind = rig.T_world_camera.copy()
    behind[:3, 3] = elbow + 2.0 * (elbow - board)
    moved = Rig(rig.camera, behind, rig.T_flange_board, rig.outline)
    shown = invert(behind) @ guard.arm.forward(view.joints) @ rig.T_flange_board
    assert not planning.unhidden(moved, guard, shown[None], view.joints[None])[0]


def test_nothing_is_visible_behind_the_camera(rig, views):
    flipped = poses(views)
    flipped[:, 2, 3] *= -1
    assert not planning.visible(rig, flipped, 0.0).any()


def test_the_back_of_a_board_is_not_visible(rig, views):
    turned = poses(views) @ np.diag([1.0, -1.0, -1.0, 1.0])
    assert not planning.visible(rig, turned, 0.0).any()


def test_search_widens_from_the_middle(rig, guard, here):
    none = np.empty((0, 4, 4))
    middle = [
        rig.camera.project(rig.board_points(poses(found[:1])).mean(axis=1))[0]
        for found in (
            planning.search_views(rig, guard, here, i, none, 50.0, seed=0) for i in (0, 12)
        )
    ]
    centre = np.array(rig.camera.image_size) / 2
    near, far = (np.linalg.norm(m - centre) for m in middle)
    assert near < 0.15 * rig.camera.image_size[0] < far


def test_no_plan_where_no_view_is_possible(config, guard, here, rig):
    blind = CameraModel(rig.camera.K, np.zeros(5), (64, 48))
    away = Rig(blind, rig.T_world_camera, rig.T_flange_board, rig.outline)
    assert planning.plan_sweep(away, guard, here, planning.Spread(), 5, seed=0) == []


def test_parking_leaves_the_light_free(config, guard, here):
    beams = parking.beams(config, known(config, None).T_world_camera)
    path = parking.way_out(guard, beams, here, NOWHERE, 0.1, seed=0)
    assert path is not None
    guard.check(here, path)
    centres, radii = guard.spheres(path.waypoints[-1:])
    assert min(beam.clearance(centres, radii)[0] for beam in beams) >= 0.1
    stay = parking.way_out(guard, beams, path.waypoints[-1], NOWHERE, 0.1, seed=0)
    assert isinstance(stay, Path)
    assert np.array_equal(stay.waypoints[-1], path.waypoints[-1])


def test_parking_goes_back_the_way_it_came(guard, config, here, monkeypatch):
    """Where no posture that is drawn can be reached, the way that led here leads out again."""
    beams = parking.beams(config, known(config, None).T_world_camera)
    out = parking.way_out(guard, beams, here, NOWHERE, 0.1, seed=0)
    assert out is not None
    came = np.vstack([out.waypoints[::-1], here])
    monkeypatch.setattr(parking, "BRIDGES", 0)
    assert parking.way_out(guard, beams, here, NOWHERE, 0.1, seed=0) is None
    back = parking.way_out(guard, beams, here, came, 0.1, seed=0)
    assert back is not None
    guard.check(here, back)
    assert parking.clearance(guard, beams, back.waypoints[-1:])[0] > 0.0


def test_beam_clearance_is_a_distance():
    square = np.array([(-1.0, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    beam = parking.Beam(np.array([0.0, 0.0, 1000.0]), square)
    centres = np.array([[[3.0, 0.0, 0.0]], [[0.0, 0.5, 0.0]]])
    clearance = beam.clearance(centres, np.array([0.25]))
    assert np.allclose(clearance, (1.75, -0.75), atol=0.01)
