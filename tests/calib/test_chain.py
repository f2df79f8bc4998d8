"""The chain and its adjustment: derivatives, and the Schur complement against dense algebra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from cellctl.calib.chain import FULL, Chain, ChainState, Free, PosePrior, Sheet
from cellctl.calib.pose import pose_matrices, pose_vectors
from cellctl.calib.schur import minimise
from cellctl.calib.views import Batch
from cellctl.errors import SolveError
from cellctl.geometry import Array
from tests.calib.synthetic import CAMERA

STEP = 1e-6
EVERYTHING = Free(FULL, poses=True, scale=True, warp=True)


@pytest.fixture
def problem() -> tuple[Chain, ChainState]:
    """Four views of seven points, two of them unseen; every kind of unknown and prior."""
    rng = np.random.default_rng(0)

    def poses(n: int, spread: float) -> Array:
        return pose_matrices(rng.normal(0, spread, (n, 6)))

    points = np.zeros((4, 7, 3))
    points[..., :2] = rng.uniform(-0.1, 0.1, (4, 7, 2))
    seen = np.ones((4, 7), dtype=bool)
    seen[2, 5:] = False
    X, Y, after, corrections = poses(1, 0.3)[0], poses(1, 0.3)[0], poses(4, 0.3), poses(4, 0.03)
    in_camera = poses(4, 0.1)
    in_camera[:, 2, 3] += 0.8
    before = X @ in_camera @ np.linalg.inv(corrections @ after @ Y)
    state = ChainState(CAMERA, X, Y, corrections, 0.01, np.array([0.001, 0.002, -0.003]))
    chain = Chain(
        Batch(points, np.zeros((4, 7, 2)), seen),
        before,
        after,
        Sheet.of(points.reshape(-1, 3)),
        EVERYTHING,
        sigma_px=0.5,
        sigma_robot=np.arange(1.0, 7.0) * 0.01,
        camera_prior=PosePrior(poses(1, 0.3)[0], np.full(6, 0.1)),
        board_prior=PosePrior(np.eye(4), np.arange(1.0, 7.0)),
    )
    noise = rng.normal(0, 0.5, (4, 7, 2))
    pixels = CAMERA.project(chain.points(state)) + noise
    return replace(chain, batch=Batch(points, pixels, seen)), state


def test_derivatives_by_globals(problem):
    chain, state = problem
    linear, priors = chain.linearise(state), chain.priors(state)
    for i in range(EVERYTHING.count):
        step = STEP * (10 if i < 4 else 1) * np.eye(EVERYTHING.count)[i]
        ends = [chain.retract(state, s * step, np.zeros((4, 6))) for s in (1, -1)]
        width = 2 * step[i]
        slope = (chain.residuals(ends[0]) - chain.residuals(ends[1])) / width
        assert np.allclose(
            linear.by_globals[..., i], slope, rtol=1e-5, atol=1e-5 * abs(slope).max()
        )
        slope = (chain.priors(ends[0]).on_globals - chain.priors(ends[1]).on_globals) / width
        assert np.allclose(priors.globals_jacobian[:, i], slope, atol=1e-6)


def test_derivatives_by_locals(problem):
    chain, state = problem
    linear, priors = chain.linearise(state), chain.priors(state)
    for i in range(6):
        step = np.zeros((4, 6))
        step[:, i] = STEP
        ends = [chain.retract(state, np.zeros(EVERYTHING.count), s * step) for s in (1, -1)]
        slope = (chain.residuals(ends[0]) - chain.residuals(ends[1])) / (2 * STEP)
        assert np.allclose(linear.by_locals[..., i], slope, rtol=1e-5, atol=1e-5 * abs(slope).max())
        slope = (chain.priors(ends[0]).on_locals - chain.priors(ends[1]).on_locals) / (2 * STEP)
        assert np.allclose(priors.locals_jacobian[..., i], slope, rtol=1e-5, atol=1e-4)


def test_schur_complement_finds_the_dense_optimum(problem):
    chain, state = problem
    chain = replace(chain, free=Free((0, 1), poses=True, scale=True))
    solution = minimise(chain, state, tolerance=1e-15)
    globals_count = chain.free.count

    def dense(vector):
        moved = chain.retract(state, vector[:globals_count], vector[globals_count:].reshape(4, 6))
        priors = chain.priors(moved)
        parts = [chain.residuals(moved).ravel(), priors.on_globals, priors.on_locals.ravel()]
        return np.concatenate(parts)

    reference = least_squares(dense, np.zeros(globals_count + 24), x_scale="jac", xtol=1e-12)
    assert solution.cost == pytest.approx(reference.cost, rel=1e-8)
    jacobian = reference.jac
    covariance = np.linalg.inv(jacobian.T @ jacobian)[:globals_count, :globals_count]
    sigma = np.sqrt(solution.globals_covariance.diagonal())
    # the dense parameters are steps from the start, the others from the optimum: nearly the same
    assert np.allclose(sigma, np.sqrt(covariance.diagonal()), rtol=0.05)


def test_hubers_loss_ignores_one_wild_corner(problem):
    chain, state = problem
    chain = replace(chain, free=Free(poses=True))
    clean = minimise(chain, state, huber=3.0).state
    pixels = chain.batch.pixels.copy()
    pixels[0, 0] += 300.0
    wild = replace(chain, batch=replace(chain.batch, pixels=pixels))
    robust = minimise(wild, state, huber=3.0).state
    squares = minimise(wild, state).state
    moved = [np.abs(s.camera_pose - clean.camera_pose).max() for s in (robust, squares)]
    assert moved[0] < 0.1 * moved[1]


def test_a_start_behind_the_camera_is_refused(problem):
    chain, state = problem
    behind = replace(state, camera_pose=state.camera_pose @ np.diag([1.0, -1.0, -1.0, 1.0]))
    with pytest.raises(SolveError, match="behind"):
        minimise(chain, behind)


def test_pose_vectors_undo_pose_matrices():
    vectors = np.random.default_rng(1).normal(0, 0.8, (50, 6))
    assert np.allclose(pose_vectors(pose_matrices(vectors)), vectors, atol=1e-12)
    assert np.allclose(pose_vectors(pose_matrices(vectors * 1e-12)), vectors * 1e-12, atol=1e-20)
