"""The published pipeline as it stands, in plain OpenCV calls and a polynomial: what is to beat.

Nothing here is shared with the product's solvers. Each stage maps world (x, y) on the table to
projector pixels; the stages are those of the paper, each with the later ones at their baselines.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.optimize import least_squares

from cellctl.calib.camera import CameraModel
from cellctl.calib.views import RobotView
from cellctl.geometry import Array, invert

DEGREE = 2
ROBOT_SIGMA = np.array([8e-4, 8e-4, 8e-4, 5e-4, 5e-4, 5e-4])
"""Of a turn (rad) and a shift (m) by which an arm is off where it says that it is."""
CORNER_SIGMA_PX = 0.1
ITERATIONS = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-9)
NO_DISTORTION = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3

Pipeline = Callable[[Array], Array]
"""World points (n, 2), metres, to projector pixels (n, 2)."""


@dataclass(frozen=True, eq=False)
class Data:
    """What the paper's authors have: views of both boards, {id: camera px} and {id: projector px}
    of the projected markers, the maker's camera, and the table's height, metres."""

    checkerboard: Sequence[RobotView]
    markers: Sequence[RobotView]
    seen: Mapping[int, Array]
    sent: Mapping[int, Array]
    factory: CameraModel
    height: float


@dataclass(frozen=True, eq=False)
class Chain:
    """A camera K (3, 3) with `distortion` (5,), T_world_camera (4, 4), and a homography to the
    projector from camera pixels: raw ones, or with distortion taken out."""

    K: Array
    distortion: Array
    pose: Array
    H: Array
    raw: bool
    height: float

    def pixels(self, xy: Array) -> Array:
        """Camera pixels (n, 2), raw or not, of world points (n, 2)."""
        points = np.column_stack([xy, np.full(len(xy), self.height)])
        to_camera = invert(self.pose)
        turn, _ = cv2.Rodrigues(to_camera[:3, :3])
        lens = self.distortion if self.raw else np.zeros(5)
        pixels, _ = cv2.projectPoints(points, turn, to_camera[:3, 3], self.K, lens)
        return pixels.reshape(-1, 2)

    def send(self, xy: Array) -> Array:
        return _mapped(self.H, self.pixels(xy))

    def sent(self, seen: Array) -> Array:
        """Projector pixels (n, 2) that light what is seen at camera pixels (n, 2)."""
        if not self.raw:
            seen = cv2.undistortPoints(
                seen.reshape(-1, 1, 2), self.K, self.distortion, P=self.K
            ).reshape(-1, 2)
        return _mapped(self.H, seen)


def pipelines(data: Data, drawn: Array, seen: Array) -> dict[str, Pipeline]:
    """The stages by name. Circles at world places `drawn` (n, 2) were seen at camera pixels `seen`
    (n, 2); only the last two stages use them."""
    size = data.factory.image_size
    plain = _calibrate(data.checkerboard, size, NO_DISTORTION)
    lens = _calibrate(data.checkerboard, size, 0)
    maker = (data.factory.K, data.factory.distortion)
    park = _hand_eye(data, *lens)
    undistorted = _chain(data, *lens, park, raw=False)
    best = replace(undistorted, pose=_by_reprojection(data, *lens, park))
    return {
        "no distortion model": _chain(data, *plain, _hand_eye(data, *plain), raw=False).send,
        "factory K, D; homography on raw pixels": _chain(
            data, *maker, _hand_eye(data, *maker), raw=True
        ).send,
        "calibrated K, D; homography on raw pixels": _chain(data, *lens, park, raw=True).send,
        "undistorted before the homography, closed-form hand-eye (Park)": undistorted.send,
        "hand-eye by reprojection": best.send,
        "homography from the circles alone": _direct(undistorted, drawn, seen),
        f"polynomial of degree {DEGREE} on the training circles": _polynomial(best, drawn, seen),
    }


def _calibrate(
    views: Sequence[RobotView], size: tuple[int, int], flags: int
) -> tuple[Array, Array]:
    """K and distortion, with no thought of a bent board."""
    points = [view.points.astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32) for view in views]
    start = np.eye(3), np.zeros(5)
    _, K, lens, _, _ = cv2.calibrateCamera(
        points, pixels, size, *start, flags=flags, criteria=ITERATIONS
    )
    return K, lens.reshape(-1)[:5]


def _board(view: RobotView, K: Array, lens: Array) -> Array:
    _, turn, shift = cv2.solvePnP(view.points, view.pixels, K, lens)
    return _pose(np.concatenate([turn.reshape(3), shift.reshape(3)]))


def _hand_eye(data: Data, K: Array, lens: Array) -> Array:
    """T_world_camera by Park and Martin. For a fixed camera the robot's poses are inverted."""
    robot = [invert(view.T_base_flange.matrix) for view in data.markers]
    board = [_board(view, K, lens) for view in data.markers]
    turn, shift = cv2.calibrateHandEye(
        [pose[:3, :3] for pose in robot],
        [pose[:3, 3] for pose in robot],
        [pose[:3, :3] for pose in board],
        [pose[:3, 3] for pose in board],
        method=cv2.CALIB_HAND_EYE_PARK,
    )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, shift.reshape(3)
    return pose


def _by_reprojection(data: Data, K: Array, lens: Array, park: Array) -> Array:
    """T_world_camera with the smallest reprojection error: scipy's least squares from the closed
    form on, over both poses, one scale of the print and, as far as ROBOT_SIGMA lets it, the pose
    that the robot reported for each view."""
    view = data.markers[0]
    board = invert(view.T_base_flange.matrix) @ park @ _board(view, K, lens)

    def errors(x: Array) -> Array:
        to_camera, on_flange = _pose(x[:6]), _pose(x[6:12])
        slips = x[13:].reshape(-1, 6)
        found = [slips.reshape(-1)]
        for seen, slip in zip(data.markers, slips, strict=True):
            pose = to_camera @ seen.T_base_flange.matrix @ _pose(slip * ROBOT_SIGMA) @ on_flange
            turn, _ = cv2.Rodrigues(pose[:3, :3])
            pixels, _ = cv2.projectPoints(x[12] * seen.points, turn, pose[:3, 3], K, lens)
            found.append((pixels.reshape(-1, 2) - seen.pixels).reshape(-1) / CORNER_SIGMA_PX)
        return np.concatenate(found)

    slips = np.zeros(6 * len(data.markers))
    start = np.concatenate([_vector(invert(park)), _vector(board), [1.0], slips])
    return invert(_pose(least_squares(errors, start, x_scale="jac").x[:6]))


def _chain(data: Data, K: Array, lens: Array, pose: Array, *, raw: bool) -> Chain:
    ids = sorted(data.seen)
    seen = np.array([data.seen[i] for i in ids])
    sent = np.array([data.sent[i] for i in ids])
    if not raw:
        seen = cv2.undistortPoints(seen.reshape(-1, 1, 2), K, lens, P=K)
    H, _ = cv2.findHomography(seen, sent)
    return Chain(K, lens, pose, H, raw, data.height)


def _direct(chain: Chain, drawn: Array, seen: Array) -> Pipeline:
    """From the robot to the projector in one homography, with no thought of lenses between."""
    H, _ = cv2.findHomography(drawn, chain.sent(seen))
    return lambda xy: _mapped(H, xy)


def _polynomial(chain: Chain, drawn: Array, seen: Array) -> Pipeline:
    """Where the chain sends light to, corrected by a polynomial in these pixels."""
    low, high = chain.send(drawn).min(axis=0), chain.send(drawn).max(axis=0)

    def powers(pixels: Array) -> Array:
        u, v = (2 * (pixels - low) / (high - low) - 1).T
        terms = [u**i * v**j for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)]
        return np.stack(terms, axis=1)

    off = chain.sent(seen) - chain.send(drawn)
    coefficients = np.linalg.lstsq(powers(chain.send(drawn)), off, rcond=None)[0]
    return lambda xy: chain.send(xy) + powers(chain.send(xy)) @ coefficients


def _mapped(H: Array, pixels: Array) -> Array:
    return cv2.perspectiveTransform(pixels.reshape(-1, 1, 2), H).reshape(-1, 2)


def _pose(vector: Array) -> Array:
    pose = np.eye(4)
    pose[:3, :3], _ = cv2.Rodrigues(vector[:3])
    pose[:3, 3] = vector[3:]
    return pose


def _vector(pose: Array) -> Array:
    turn, _ = cv2.Rodrigues(pose[:3, :3])
    return np.concatenate([turn.reshape(3), pose[:3, 3]])
