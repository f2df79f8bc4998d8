"""Views for hand-eye that are chosen: nine of them are worth eighteen of chance."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.views import rig_of
from cellctl import ik
from cellctl.calib.camera import CameraModel
from cellctl.calib.hand_eye import solve_hand_eye
from cellctl.calib.pose_design import CORNER_SIGMA_PX, view_design, view_rows
from cellctl.geometry import Array, Transform, pose_matrix
from cellctl.procedures.choice import most_telling
from cellctl.procedures.planning import Spread, candidates
from cellctl.procedures.rig import PlannedView, Rig
from cellctl.sim.presets import CR
from cellctl.sim.truth import Truth, draw, scoring_grid
from tests.calib.numeric_cell import HOME, numeric_cell

PERFECT = replace(CR.arm_errors, zero_sigma_deg=0.0, length_sigma_m=0.0, twist_sigma_deg=0.0)
"""An arm that only repeats badly: what kinematics are off by is the same for any choice."""
SEEDS, FEW, MANY = 8, 9, 18


def reachable(truth: Truth, rig: Rig, rng: np.random.Generator) -> list[PlannedView]:
    poses = candidates(rig, Spread(fill=(0.2, 0.35)), 90, int(rng.integers(1000)))
    starts = np.vstack([HOME, ik.random_starts(truth.nominal_arm, 6, 0)])
    found = ik.solutions(truth.nominal_arm, rig.flange(poses), HOME, starts)
    return [PlannedView(p, q[0]) for p, q in zip(poses, found, strict=True) if len(q)]


def table(truth: Truth) -> Array:
    xy = scoring_grid(truth.preset)
    return np.column_stack([xy, np.full(len(xy), truth.preset.table.centre_m[2])])


def chosen(truth, name, count, rng):
    rig = rig_of(truth, name)
    views = most_telling(rig, reachable(truth, rig, rng), count + 4, table(truth))
    return [view.joints for view in views]


def by_chance(truth, name, count, rng):
    return [view.joints for view in reachable(truth, rig_of(truth, name), rng)]


def hand_eye_mm(seed: int, count: int, poser) -> float:
    """By how much hand-eye's pose moves the picture of the table, millimetres on the table."""
    cell = numeric_cell(seed, 0, count, replace(CR, arm_errors=PERFECT), poser)
    lens, points = cell.truth.camera.lens, table(cell.truth)
    vector = np.array([*lens.focal, *lens.centre, *lens.distortion])
    camera = CameraModel.from_vector(vector, lens.size)
    pose = solve_hand_eye(cell.hand_eye, "eye-to-hand", camera=camera).camera_pose
    seen, true = (p.inverse().apply(points) for p in (pose, cell.truth.camera.pose))
    gap = seen[:, :2] / seen[:, 2:] - true[:, :2] / true[:, 2:]
    return 1e3 * float(np.sqrt(np.mean(np.square(gap * true[:, 2:]).sum(axis=1))))


@pytest.mark.skipif("CELLCTL_SOAK" not in os.environ, reason="a minute; set CELLCTL_SOAK")
def test_nine_chosen_views_are_worth_eighteen_of_chance():
    """Of eight cells: 0.080 mm, 0.070 by 18 views of chance, 0.098 by 9 of them."""
    few = [hand_eye_mm(seed, FEW, chosen) for seed in range(SEEDS)]
    many = [hand_eye_mm(seed, MANY, by_chance) for seed in range(SEEDS)]
    assert np.sqrt(np.mean(np.square(few))) < 1.2 * np.sqrt(np.mean(np.square(many)))


@pytest.mark.parametrize("seed", range(3))
def test_nine_are_predicted_to_be_worth_ten_of_chance(seed):
    """Of candidates that are all tilted well already."""
    truth = draw(CR, seed)
    rig, rng = rig_of(truth, "markers"), np.random.default_rng(seed)
    views = reachable(truth, rig, rng)

    def predicted(some: list[PlannedView]) -> float:
        design = view_design(table(truth), rig.T_world_camera)
        poses = np.array([view.T_camera_board for view in some])
        flat = rig.board_points(np.eye(4)[None], 4)[0]
        for row in view_rows(flat, poses, rig.T_flange_board, float(rig.camera.K[0, 0])):
            design.add(row)
        return design.error

    def chance(count: int) -> list[float]:
        orders = [rng.permutation(len(views))[:count] for _ in range(30)]
        return [predicted([views[i] for i in order]) for order in orders]

    best = most_telling(rig, views, FEW, table(truth))
    assert predicted(best) < min(chance(FEW))
    assert predicted(best) < np.median(chance(10))
    assert predicted(best[: FEW // 2]) > predicted(best)
    assert most_telling(rig, [], 5, table(truth)) == []


@pytest.mark.parametrize("column", range(13))
def test_rows_are_derivatives(column):
    """Of pixels, in standard deviations; the arm's errors only take from what they tell."""
    truth = draw(CR, 1)
    rig = rig_of(truth, "markers")
    flat = rig.board_points(np.eye(4)[None], 3)[0]
    pose = candidates(rig, Spread(), 1, 0)
    focal = float(rig.camera.K[0, 0])

    def pixels(step: float) -> Array:
        move = np.zeros(13)
        move[column] = step
        board = flat * (1.0 + move[12])
        placed = Transform("a", "b", pose[0] @ pose_matrix(move[6:9], move[9:12])).apply(board)
        moved = Transform("a", "b", pose_matrix(move[:3], move[3:6])).inverse().apply(placed)
        return focal * moved[:, :2] / moved[:, 2:]

    slope = ((pixels(1e-6) - pixels(-1e-6)) / 2e-6).reshape(-1)
    row = view_rows(flat, pose, rig.T_flange_board, focal)[0]
    sure = view_rows(flat, pose, rig.T_flange_board, focal, robot_sigma=np.zeros(6))[0]
    assert sure[:, column] * CORNER_SIGMA_PX == pytest.approx(slope, rel=1e-4, abs=1e-3)
    assert np.linalg.norm(row[:, column]) <= np.linalg.norm(sure[:, column]) + 1e-9
