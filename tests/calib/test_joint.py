"""The joint adjustment: derivatives, gauge of its parts, what it reaches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cellctl.calib.joint.observations import Observations
from cellctl.calib.joint.problem import JointProblem
from cellctl.calib.joint.solve import solve_joint
from cellctl.calib.joint.start import JointOptions, begin
from cellctl.calib.joint.state import FullProjector, JointState
from cellctl.calib.pose import pose_matrices
from cellctl.calib.views import RobotView
from cellctl.errors import BadInput
from cellctl.geometry import Array, Transform, invert
from tests.calib.joint_world import JointWorld, joint_world


@pytest.fixture(scope="module")
def world() -> JointWorld:
    return joint_world(0, views=(4, 3), spots=12, lit_boards=2)


def moved_problem(seen: Observations, world: JointWorld) -> tuple[JointProblem, JointState]:
    """A problem away from its start, where nothing is zero."""
    problem, state = begin(seen, world.start, JointOptions(table="bow and twist"), world.area)
    rng = np.random.default_rng(0)
    step = 1e-3 * rng.normal(size=problem.layout.count)
    if "camera" in problem.layout:
        step[problem.layout.slices["camera"]][:4] *= 100.0
    if not isinstance(state.projector, FullProjector):
        step[problem.layout.slices["projector"]][:8] *= 1e-2
    off = 1e-2 * rng.normal(size=(len(state.corrections), 6))
    return problem, problem.retract(state, step, off)


@pytest.mark.parametrize("kind", ["plane map", "full projector", "camera on the arm"])
def test_derivatives(world, kind):
    seen = world.seen
    if kind == "plane map":
        seen = replace(seen, lit_boards=())
    if kind == "camera on the arm":
        seen = on_the_arm(world)
    problem, state = moved_problem(seen, world)
    parts, residuals = problem.linearise(state), problem.residuals(state)
    for part, expected in zip(parts, residuals, strict=True):
        assert np.allclose(part.residuals, expected, atol=1e-9)
    none = np.zeros((len(state.corrections), 6))
    for i in range(problem.layout.count):
        step = np.eye(problem.layout.count)[i] * step_of(problem, i)
        slopes = difference(problem, state, step, none)
        for part, slope in zip(parts, slopes, strict=True):
            place = np.flatnonzero(part.columns == i)
            analytic = part.by_globals[..., place[0]] if len(place) else np.zeros_like(slope)
            off = np.abs(analytic - slope).max() * step.max()
            assert off < 2e-5 * max(np.abs(slope).max() * step.max(), 1e-3), i
    for i in range(6):
        slopes = difference(
            problem, state, np.zeros(problem.layout.count), none + 1e-6 * np.eye(6)[i]
        )
        for part, slope in zip(parts, slopes, strict=True):
            if part.by_locals.shape[-1]:
                assert np.allclose(
                    part.by_locals[..., i], slope, rtol=1e-4, atol=1e-4 * np.abs(slope).max()
                )


def step_of(problem: JointProblem, column: int) -> float:
    name = next(n for n, s in problem.layout.slices.items() if s.start <= column < s.stop)
    return 1e-4 if name == "camera" and column < 4 else 1e-6


def difference(
    problem: JointProblem, state: JointState, step: Array, locals_: Array
) -> list[Array]:
    size = max(np.abs(step).max(), np.abs(locals_).max())
    after = problem.residuals(problem.retract(state, step, locals_))
    before = problem.residuals(problem.retract(state, -step, -locals_))
    return [(a - b) / (2 * size) for a, b in zip(after, before, strict=True)]


def on_the_arm(world: JointWorld) -> Observations:
    """The same pictures, told as if the camera rode on the arm and the boards stood still."""
    seen = world.seen
    look = Transform("world", "flange", pose_matrices(np.full((1, 6), 0.2))[0])
    groups = []
    for group in seen.views:
        views = []
        for view in group.views:
            assert isinstance(view, RobotView)
            flange = look.matrix @ invert(view.T_base_flange.matrix)
            views.append(replace(view, T_base_flange=Transform("world", "flange", flange)))
        groups.append(replace(group, views=views))
    return replace(seen, mount="eye-in-hand", views=groups, look=look)


def test_a_second_plane_shows_the_whole_projector():
    world = joint_world(1, lit_boards=5)
    result = solve_joint(world.seen, world.start, area=world.area)
    projector, true = result.state.full_projector, world.truth.projector
    assert world.score(result.calibration) < 0.15
    assert projector.lens.K[0, 0] == pytest.approx(true.lens.focal[0], rel=0.01)
    above = world.grid.points + (0.0, 0.0, 0.1)
    camera = Transform("world", "camera", result.state.camera_pose)
    # The robot's frame is only known to its own error: compare through the camera's.
    same = world.truth.camera.pose.apply(camera.inverse().apply(above))
    off = projector.project(above) - true.project(same)
    assert np.sqrt(np.square(off).sum(axis=1).mean()) < 2.0  # px of 0.43 mm


def test_the_order_of_circles_does_not_matter(world):
    seen = replace(world.seen, lit_boards=())
    turned = replace(seen, circles=seen.circles[np.arange(len(seen.circles))[::-1]])
    one, other = (solve_joint(s, world.start, area=world.area) for s in (seen, turned))
    places = world.grid.points[:, :2]
    assert np.abs(one.calibration.project(places) - other.calibration.project(places)).max() < 1e-4


def test_a_camera_on_the_arm_is_solved_too(world):
    seen = on_the_arm(world)
    start = replace(
        world.start,
        T_world_camera=Transform("world", "camera", world.start.T_world_camera.matrix),
    )
    result = solve_joint(replace(seen, lit_boards=()), start, area=world.area)
    assert world.score(result.calibration) < 0.4


def test_bad_input_is_named(world):
    with pytest.raises(BadInput, match="different names"):
        replace(world.seen, views=[world.seen.views[0]] * 2)
    lost = replace(world.seen, lit_boards=[replace(world.seen.lit_boards[0], view="nowhere")])
    with pytest.raises(BadInput, match="no view"):
        solve_joint(lost, world.start, area=world.area)
