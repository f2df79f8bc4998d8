"""Is the joint adjustment as good as it says? In worlds that are what its model says, and in the
simulated cells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cellctl.calib.joint.held_out import held_out_pixels, joint_candidate, predict
from cellctl.calib.joint.observations import Observations
from cellctl.calib.joint.pictures import light_on_table, pen, world_camera
from cellctl.calib.joint.problem import ROBOT_COMMON, JointProblem
from cellctl.calib.joint.result import JointResult
from cellctl.calib.joint.solve import solve_joint
from cellctl.calib.joint.state import JointState
from cellctl.calib.joint.uncertainty import curve, error_map, what_next
from cellctl.calib.pose import pose_matrices, pose_vectors
from cellctl.calib.projector_map import ProjectorMap
from cellctl.calib.refine import rows
from cellctl.calib.refine_fit import Mark, Marks
from cellctl.calib.schur import inverse_of
from cellctl.errors import SolveError
from cellctl.geometry import Array, invert
from tests.calib.joint_world import JointWorld, joint_world, true_pose_error, true_tcp

DRAWS = 12
RATIO = (0.8, 1.25)
Z = {"camera": [0, 1, 2, 3, 4, 5], "pose": None, "tcp": None, "table": None, "projector": [8]}
"""Groups of unknowns whose errors are pooled in standard deviations, and which of theirs."""


@pytest.fixture(scope="module")
def world() -> JointWorld:
    return joint_world(3, views=(12, 8), spots=40)


@pytest.fixture(scope="module")
def result(world) -> JointResult:
    return solve_joint(world.seen, world.start, area=world.area)


def drawn_state(result: JointResult, rng: np.random.Generator) -> JointState:
    """A cell like the one found, with all that is random drawn anew from what the model says."""
    problem, state, sigma = result.problem, result.state, result.problem.sigma
    off = rng.normal(size=(len(state.corrections), 6)) * problem.robot_sigma
    common = rng.normal(size=(1, 6)) * ROBOT_COMMON * problem.robot_sigma
    half = (state.table.area.high - state.table.area.low) / 2
    edges = ROBOT_COMMON * sigma["turn"] * half
    return replace(
        state,
        corrections=pose_matrices(off),
        robot_off=pose_matrices(common)[0],
        field=rng.normal(size=state.field.shape) * sigma["field"],
        bend=rng.normal(size=state.bend.shape) * sigma["bend"],
        level=rng.normal(size=3) * np.append(1e-3, edges),
    )


def drawn_observations(
    result: JointResult, truth: JointState, rng: np.random.Generator
) -> Observations:
    """What would be seen there."""
    problem, seen = result.problem, result.seen
    views = []
    for group, was in zip(problem.groups, seen.views, strict=True):
        errors = group.chain.errors(group.chain_state(truth))
        errors = errors + rng.normal(size=errors.shape) * problem.sigma[group.name]
        moved = [
            replace(v, pixels=v.pixels + e[: len(v.pixels)])
            for v, e in zip(was.views, errors, strict=True)
        ]
        views.append(replace(was, views=moved))
    off = {
        name: (part.residuals[0] + rng.normal(size=part.residuals[0].shape)) * problem.sigma[name]
        for name, part in problem.global_parts(truth).items()
    }
    circles = (np.linalg.inv(problem.mm) @ off["draw"][..., None])[..., 0]
    touches = problem.touches.copy()
    touches[:, 2] += off["touch"][:, 0]
    return replace(
        seen,
        views=views,
        touches=touches,
        markers=replace(seen.markers, camera_px=seen.markers.camera_px + off["markers"]),
        circles=replace(seen.circles, pixels=seen.circles.pixels + circles),
    )


def gaps_mm(problem: JointProblem, truth: JointState, result: JointResult, places: Array) -> Array:
    """From the pen to the light (n, 2) in a cell that is what `truth` says."""
    ones = np.broadcast_to(np.eye(2), (len(places), 2, 2))
    drawn = pen(truth, problem.look, problem.field, places, ones)
    lit = light_on_table(truth, problem.look, problem.bend, result.calibration.project(places))
    off = np.linalg.inv(drawn.slopes["place"]) @ (lit.xy - drawn.xy)[..., None]
    return 1e3 * off[..., 0]


def off_by(found: JointState, truth: JointState, name: str) -> Array:
    """Errors of a group of unknowns."""
    if name == "camera":
        return found.camera.vector - truth.camera.vector
    if name == "pose":
        return pose_vectors((invert(truth.camera_pose) @ found.camera_pose)[None])[0]
    if name == "tcp":
        return found.tcp - truth.tcp
    if name == "table":
        return found.table.coefficients - truth.table.coefficients
    assert isinstance(found.projector, ProjectorMap)
    assert isinstance(truth.projector, ProjectorMap)
    step = np.zeros(12)
    step[8:10] = found.projector.radial - truth.projector.radial
    return step


def test_predicted_and_actual_error_agree_where_the_model_holds(world, result):
    rng = np.random.default_rng(8)
    places = world.grid.points[:, :2]
    actual, predicted = [], []
    z: dict[str, list[float]] = {name: [] for name in Z}
    for _ in range(DRAWS):
        truth = drawn_state(result, rng)
        seen = drawn_observations(result, truth, rng)
        found = solve_joint(seen, world.start, area=world.area)
        actual.append(gaps_mm(result.problem, truth, found, places))
        predicted.append(error_map(found, places).rms_mm ** 2)
        for name, chosen in Z.items():
            error = off_by(found.state, truth, name) / np.sqrt(found.covariance_of(name).diagonal())
            z[name] += np.square(error if chosen is None else error[chosen]).tolist()
    total = np.square(np.concatenate(actual)).sum(axis=1).mean()
    ratio = np.sqrt(total / np.mean(predicted))
    assert RATIO[0] < ratio < RATIO[1], ratio
    for name, squares in z.items():
        spread = 3.0 / np.sqrt(2.0 * DRAWS)  # of so few independent draws
        assert abs(np.sqrt(np.mean(squares)) - 1.0) < max(spread, 0.25), (name, np.mean(squares))


@pytest.mark.parametrize("cell", ["cr", "ir"])
def test_predicted_and_actual_error_agree_in_the_simulated_cells(cell):
    actual, predicted, tcp = [], [], []
    for seed in range(5):
        one = joint_world(seed, cell)
        found = solve_joint(one.seen, one.start, area=one.area)
        actual.append(one.score(found.calibration))
        predicted.append(error_map(found, one.grid.points[:, :2]).rms_mm)
        off = (found.state.tcp - true_tcp(one)) / np.sqrt(found.covariance_of("tcp").diagonal())
        tcp.append(np.square(off).mean())
        pose = true_pose_error(one.truth, found.calibration.T_world_camera.matrix)
        assert np.all(np.abs(pose) < 5 * np.sqrt(found.covariance_of("pose").diagonal()))
    assert np.median(actual) < 0.15
    ratio = np.sqrt(np.mean(np.square(actual)) / np.mean(np.square(predicted)))
    assert 0.7 < ratio < 1.4, ratio
    assert np.mean(tcp) < 4.0


def test_the_budget_adds_up(world, result):
    found = error_map(result, world.grid.points[:, :2])
    total = np.sqrt(sum(v**2 for v in found.budget_mm.values()))
    assert total == pytest.approx(found.rms_mm, rel=1e-6)
    assert {
        "intrinsic views",
        "hand-eye views",
        "tcp",
        "plane",
        "projector",
        "drawing",
        "arm",
    } <= set(found.budget_mm)
    assert found.budget_mm["drawing"] > found.budget_mm["plane"]


def test_information_of_the_groups_makes_the_whole(result):
    S = sum(units.sum(axis=0) for units in result.information.values())
    assert np.allclose(inverse_of(np.asarray(S)), result.covariance, rtol=1e-4, atol=1e-12)


def test_more_data_help_and_circles_most(world, result):
    places = world.grid.points[:, :2]
    gains = what_next(result, places)
    assert next(iter(gains)) == "circles"
    assert max(gains.values()) <= error_map(result, places).rms_mm * (1 + 1e-9)
    steps = curve(result, places, "circles")
    errors = [step.rms_mm for step in steps]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] == pytest.approx(error_map(result, places).rms_mm, rel=1e-6)


def test_held_out_predictions_are_those_of_an_adjustment_without_the_circle(world, result):
    count = len(world.seen.circles)
    held_out = held_out_pixels(result, np.arange(count)[None])[..., 0]
    for i in (0, 7):
        rest = replace(world.seen, circles=world.seen.circles[np.arange(count) != i])
        without = solve_joint(rest, world.start, area=world.area)
        expected = predict(without, world.seen.circles[[i]])[0]
        inside = predict(result, world.seen.circles[[i]])[0]
        assert np.linalg.norm(held_out[i] - expected) < 0.2 * np.linalg.norm(inside - expected)


def test_the_calibration_says_what_the_adjustment_says(world, result):
    """Light sent through the calibration lands in the picture where the pen is seen."""
    places = world.grid.points[:, :2]
    assert np.abs(gaps_mm(result.problem, result.state, result, places)).max() < 2e-3
    T = world_camera(result.state, result.problem.look)
    assert np.allclose(T, result.calibration.T_world_camera.matrix)


def test_it_stands_beside_the_corrections(world, result):
    """In the base's coordinates, by the same measure, with the pen's offset and its noise."""
    base, circles = world.start, world.seen.circles
    seen = base.camera.normalise(circles.pixels)
    rows_of = zip(circles.keys, circles.xy, circles.yaw, seen, strict=True)
    marks = Marks.of([Mark(key, xy, float(yaw), at) for key, xy, yaw, at in rows_of], base)
    used = np.ones(len(marks), dtype=bool)
    candidate = joint_candidate(result, marks, used, base, rows(marks.xy))
    assert candidate.errors["training"].mm < candidate.errors["leave_one_out"].mm < 0.5
    assert candidate.errors["leave_one_out"].mm <= candidate.errors["leave_row_out"].mm * 1.1
    assert candidate.fit is not None
    assert np.allclose(candidate.fit.predict(marks), seen, atol=2e-3)
    assert 30 < candidate.fit.freedom < 2 * len(marks)
    with pytest.raises(SolveError, match="other circles"):
        joint_candidate(result, marks, ~used, base, rows(marks.xy))
