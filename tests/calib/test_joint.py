"""The joint adjustment: derivatives, gauge of its parts, what it reaches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cellctl.calib.joint.observations import Observations
from cellctl.calib.joint.problem import JointProblem
from cellctl.calib.joint.start import JointOptions, begin
from cellctl.calib.joint.state import FullProjector, JointState
from cellctl.calib.pose import pose_matrices
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
            scale = max(np.abs(slope).max(), 1e-6 / step.max())
            assert np.abs(analytic / 1.0 * step.max() - slope * step.max()).max() < 2e-5 * max(
                scale * step.max(), 1e-3
            ), (problem.layout.sizes, i)
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
    groups = [
        replace(
            group,
            views=[
                replace(
                    v,
                    T_base_flange=Transform(
                        "world", "flange", look.matrix @ invert(v.T_base_flange.matrix)
                    ),
                )
                for v in group.views
            ],
        )
        for group in seen.views
    ]
    return replace(seen, mount="eye-in-hand", views=groups, look=look)
