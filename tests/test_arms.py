"""Kinematics of both arms: known poses, the Jacobian, inverse against forward."""

from __future__ import annotations

import numpy as np
import pytest

from cellctl import ik
from cellctl.arms import ARMS, arm
from cellctl.errors import BadInput

HOMES = {
    "ur5": np.radians([-90.0, -90.0, 90.0, -90.0, -90.0, 0.0]),
    "irb4600-60/2.05": np.radians([0.0, 0.0, 0.0, 0.0, 30.0, 0.0]),
}
arms = pytest.mark.parametrize("model", ARMS.values(), ids=ARMS.keys())


def test_ur5_zero_pose_of_its_manual():
    flange = arm("ur5").forward(np.zeros(6))
    assert np.allclose(flange[:3, 3], (-0.81725, -0.19145, -0.005491), atol=1e-6)


def test_irb4600_zero_pose_of_its_manual():
    flange = arm("irb4600-60/2.05").forward(np.zeros(6))
    assert np.allclose(flange[:3, 3], (0.175 + 0.960 + 0.135, 0.0, 0.495 + 0.900 + 0.175))
    assert np.allclose(flange[:3, 2], (1.0, 0.0, 0.0))


@arms
def test_jacobian_is_the_derivative_of_forward(model):
    joints = HOMES[model.name] + 0.1
    jacobian = model.jacobian(model.link_frames(joints))
    for i in range(6):
        step = np.zeros(6)
        step[i] = 1e-6
        moved = ik.pose_errors(model.forward(joints)[None], model.forward(joints + step)[None])
        assert np.allclose(jacobian[:, i], moved[0] / 1e-6, atol=1e-5)


@arms
def test_inverse_finds_the_pose_again(model):
    rng = np.random.default_rng(3)
    joints = HOMES[model.name] + rng.uniform(-0.6, 0.6, (20, 6))
    targets = model.forward(joints)
    starts = ik.random_starts(model, 12, seed=1)
    found = ik.solutions(model, targets, HOMES[model.name], starts)
    for target, solutions in zip(targets, found, strict=True):
        assert len(solutions) > 0
        assert np.allclose(model.forward(solutions), target, atol=1e-5)
        assert model.within_limits(solutions, 0.05).all()


@arms
def test_unreachable_pose_has_no_solution(model):
    target = np.eye(4)
    target[:3, 3] = (4.0, 0.0, 0.0)
    starts = ik.random_starts(model, 4, seed=1)
    assert ik.solutions(model, target[None], HOMES[model.name], starts)[0].shape == (0, 6)


def test_unknown_arm_lists_the_known_ones():
    with pytest.raises(BadInput, match="unknown arm 'ur55'"):
        arm("ur55")


@arms
def test_no_flange_is_where_the_arm_may_not_reach(model):
    joints = np.random.default_rng(3).uniform(-np.pi, np.pi, (3000, 6))
    places = model.forward(joints)[:, :3, 3]
    assert model.may_reach(places).all()
    assert not model.may_reach(1.5 * places[np.linalg.norm(places, axis=1).argmax()])
