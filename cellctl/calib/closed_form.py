"""Hand-eye in closed form: A_i Y = X C_i for n views.

X is the pose of the camera on its anchor, Y that of the board on its mount, A_i what the robot
says (T_base_flange eye-to-hand, its inverse eye-in-hand) and C_i = T_camera_board. These serve as
starts of the adjustment, and as candidates that it has to beat.

Sources, all through OpenCV: Tsai and Lenz 1989; Park and Martin 1994; Horaud and Dornaika 1995;
Daniilidis 1999; Shah 2013. Andreff and Li are left out: on real data they are off by up to ten
times the others' error.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import comb

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from cellctl.errors import SolveError
from cellctl.geometry import Array, invert

HAND_EYE = {
    "park": cv2.CALIB_HAND_EYE_PARK,
    "horaud": cv2.CALIB_HAND_EYE_HORAUD,
    "daniilidis": cv2.CALIB_HAND_EYE_DANIILIDIS,
    "tsai": cv2.CALIB_HAND_EYE_TSAI,
}
METHODS = (*HAND_EYE, "shah")
SUBSETS, SUBSET_SIZE = 60, 4
LEVER_M = 0.5
"""An angle of a discrepancy counts like the way of a point at this distance."""
SCALE_WEIGHT_M = 0.01
"""What a board of twice its stated size costs beside discrepancies, metres."""


def closed_form(method: str, A: Array, C: Array) -> tuple[Array, Array]:
    """X and Y (4, 4) from A and C (n, 4, 4), n >= 3, by one of METHODS.

    SolveError when the motion does not determine them.
    """
    try:
        X, Y = _shah(A, C) if method == "shah" else _hand_eye(HAND_EYE[method], A, C)
    except cv2.error as error:
        raise SolveError(f"hand-eye by {method}: {error.err}") from None
    if not (np.isfinite(X).all() and np.isfinite(Y).all()):
        raise SolveError(f"hand-eye by {method}: the robot's poses do not determine it")
    return X, Y


def _hand_eye(method: int, A: Array, C: Array) -> tuple[Array, Array]:
    G = invert(A)
    turn, shift = cv2.calibrateHandEye(
        list(G[:, :3, :3]), list(G[:, :3, 3]), list(C[:, :3, :3]), list(C[:, :3, 3]), method=method
    )
    X = _pose(turn, shift)
    if not np.isfinite(X).all():
        return X, X
    return X, mean_pose(invert(A) @ X @ C)


def _shah(A: Array, C: Array) -> tuple[Array, Array]:
    """OpenCV's robot-world problem C_i Y^-1 = X^-1 A_i."""
    board_turn, board_shift, camera_turn, camera_shift = cv2.calibrateRobotWorldHandEye(
        list(C[:, :3, :3]),
        list(C[:, :3, 3]),
        list(A[:, :3, :3]),
        list(A[:, :3, 3]),
        method=cv2.CALIB_ROBOT_WORLD_HAND_EYE_SHAH,
    )
    return invert(_pose(camera_turn, camera_shift)), invert(_pose(board_turn, board_shift))


def _pose(turn: Array, shift: Array) -> Array:
    """(4, 4), its rotation the nearest true one."""
    u, _, vt = np.linalg.svd(np.nan_to_num(turn, nan=0.0))
    matrix = np.eye(4)
    matrix[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    matrix[:3, 3] = np.reshape(shift, 3)
    if not np.isfinite(turn).all():
        matrix[:] = np.nan
    return matrix


def mean_pose(poses: Array) -> Array:
    """Chordal mean of rotations, arithmetic mean of translations, of (n, 4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_matrix(poses[:, :3, :3]).mean().as_matrix()
    matrix[:3, 3] = poses[:, :3, 3].mean(axis=0)
    return matrix


def discrepancies(X: Array, Y: Array, A: Array, C: Array) -> tuple[Array, Array]:
    """Metres (n,) and radians (n,) between where chain and pictures have the board."""
    off = invert(A @ Y) @ X @ C
    return np.linalg.norm(off[:, :3, 3], axis=1), _angles(off)


def robust_start(A: Array, C: Array) -> tuple[Array, Array]:
    """X and Y that agree best with the median view: Park's closed form over small subsets.

    Least median of squares (Rousseeuw, 1984), with always the same subsets. It stands almost
    half of the views being wrong. SolveError when no subset determines the answer.
    """
    start = _consensus(A, C, _park)
    return start.X, start.Y


def scaled_start(A: Array, C: Array) -> Consensus:
    """As `robust_start`, for boards whose stated size may be wrong by any factor: it is the
    factor by which the pictures' translations have to be multiplied. Negative for mirrored
    pictures: a mirror turns every rotation into one about another axis, and every translation
    into its opposite."""
    return _consensus(A, C, _park_and_scale)


@dataclass(frozen=True, eq=False)
class Consensus:
    """X, Y (4, 4) and the board's `scale`; the median discrepancy of the views in metres and
    in radians, and both as one length, `score`."""

    X: Array
    Y: Array
    scale: float
    shift: float
    angle: float
    score: float


def _park(A: Array, C: Array) -> tuple[Array, Array, float]:
    return *closed_form("park", A, C), 1.0


def _park_and_scale(A: Array, C: Array) -> tuple[Array, Array, float]:
    """Rotations by Park; then translations and scale s, in which A Y = X C is linear:
    R_A t_Y + t_A = s R_X t_C + t_X. A scale that the motion does not show stays at one."""
    X, Y = closed_form("park", A, C)
    n = len(A)
    M = np.zeros((3 * n + 1, 7))
    M[:-1, :3] = A[:, :3, :3].reshape(-1, 3)
    M[:-1, 3:6] = -np.tile(np.eye(3), (n, 1))
    M[:-1, 6] = -(C[:, :3, 3] @ X[:3, :3].T).reshape(-1)
    M[-1, 6] = SCALE_WEIGHT_M
    b = np.append(-A[:, :3, 3].reshape(-1), SCALE_WEIGHT_M)
    found = np.linalg.lstsq(M, b, rcond=None)[0]
    X, Y = X.copy(), Y.copy()
    Y[:3, 3], X[:3, 3] = found[:3], found[3:6]
    return X, Y, float(found[6])


def scaled(C: Array, scale: float) -> Array:
    """Poses (n, 4, 4) with their translations multiplied."""
    C = C.copy()
    C[:, :3, 3] *= scale
    return C


def _consensus(
    A: Array, C: Array, solve: Callable[[Array, Array], tuple[Array, Array, float]]
) -> Consensus:
    best: Consensus | None = None
    for subset in _subsets(len(A)):
        try:
            X, Y, scale = solve(A[subset], C[subset])
        except SolveError:
            continue
        shifts, angles = discrepancies(X, Y, A, scaled(C, scale))
        score = float(np.median(shifts + LEVER_M * angles))
        if best is None or score < best.score:
            best = Consensus(X, Y, scale, float(np.median(shifts)), float(np.median(angles)), score)
    if best is None:
        raise SolveError(
            "the robot's poses do not determine hand-eye: the flange has to turn about at least "
            "two different axes between the views"
        )
    return best


def _subsets(n: int) -> list[Array]:
    """All views, and up to SUBSETS different choices of SUBSET_SIZE of them."""
    everything = [np.arange(n)]
    if n <= SUBSET_SIZE:
        return everything
    if comb(n, SUBSET_SIZE) <= SUBSETS:
        return everything + [np.array(one) for one in combinations(range(n), SUBSET_SIZE)]
    rng, chosen = np.random.default_rng(0), set[tuple[int, ...]]()
    while len(chosen) < SUBSETS:
        chosen.add(tuple(sorted(rng.choice(n, SUBSET_SIZE, replace=False).tolist())))
    return everything + [np.array(one) for one in sorted(chosen)]


def consistent_options(A: Array, options: Sequence[Array]) -> list[int]:
    """Which of several poses of the board belongs to each view.

    `options` holds (m_i, 4, 4) possible T_camera_board of each view. Between two views the
    board turns by the same angle as the flange, whatever X and Y are; the choice that keeps
    this best, seen from the best reference view, wins.
    """
    best, best_cost = [0] * len(options), np.inf
    for reference, poses in enumerate(options):
        flange = _angles(invert(A[reference])[None] @ A)
        for pose in poses:
            off = [
                np.abs(_angles(invert(pose)[None] @ others) - angle)
                for others, angle in zip(options, flange, strict=True)
            ]
            cost = float(sum(min(o.min(), 0.2) for o in off))
            if cost < best_cost:
                best, best_cost = [int(np.argmin(o)) for o in off], cost
    return best


def _angles(matrices: Array) -> Array:
    """Rotation angles (n,) in radians of (n, 4, 4)."""
    return Rotation.from_matrix(matrices[:, :3, :3]).magnitude()


def axis_scatter_deg(A: Array) -> Array:
    """How much the flange turned about three axes between the views, degrees, ascending (3,).

    Square roots of the eigenvalues of the mean of r r^T over all pairs of views, r the rotation
    vector from one to the other. Hand-eye needs two axes, and is sound with three.
    """
    pairs = list(combinations(range(len(A)), 2))
    i, j = np.array(pairs).T
    turns = Rotation.from_matrix((invert(A[i]) @ A[j])[:, :3, :3]).as_rotvec(degrees=True)
    scatter = np.einsum("pi,pj->ij", turns, turns) / len(pairs)
    return np.sqrt(np.maximum(np.linalg.eigvalsh(scatter), 0.0))
