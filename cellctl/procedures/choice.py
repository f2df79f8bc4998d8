"""Which of many possible views make a good set."""

from __future__ import annotations

import numpy as np

from cellctl.calib.design import greedy
from cellctl.calib.pose_design import view_design, view_rows
from cellctl.geometry import Array, invert
from cellctl.procedures.rig import PlannedView, Rig

SUBSETS = 2000
DEPTH_WEIGHT = 0.3
GRID = 4
"""Points of a board, each way, that stand for its corners."""
RIDGE = 1e-9
"""Keeps the place of motions about parallel axes finite."""


def spread_out(rig: Rig, views: list[PlannedView], count: int) -> list[PlannedView]:
    """Up to `count` of `views`, far apart from each other, the most extreme first.

    Farthest-point sampling over where the board is in the picture, how large, how tilted and how
    spun it is (Gonzalez 1985); deterministic.
    """
    if len(views) <= count:
        return list(views)
    places = features(rig, np.array([view.T_camera_board for view in views]))
    chosen = [int(np.argmax(np.linalg.norm(places - places.mean(axis=0), axis=1)))]
    distance = np.linalg.norm(places - places[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(places - places[chosen[-1]], axis=1))
    return [views[i] for i in chosen]


def features(rig: Rig, poses: Array) -> Array:
    """Dimensionless features (n, 7) in which one unit is about equally informative everywhere."""
    points = rig.board_points(poses)
    middle = rig.camera.project(points.mean(axis=1)) / np.array(rig.camera.image_size)
    tilt = poses[:, :2, 2]
    spin = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    return np.column_stack(
        [
            4.0 * middle,
            1.5 * tilt,
            0.3 * np.cos(spin),
            0.3 * np.sin(spin),
            np.log(points[..., 2].mean(axis=1)),
        ]
    )


def most_telling(
    rig: Rig, views: list[PlannedView], count: int, places: Array
) -> list[PlannedView]:
    """Up to `count` of `views`, best first: after each, hand-eye's pose of the camera is known best
    for what it is needed for, where the camera sees world places (g, 3) of the table."""
    if not views:
        return []
    poses = np.array([view.T_camera_board for view in views])
    flat = rig.board_points(np.eye(4)[None], GRID)[0]
    rows = view_rows(flat, poses, rig.T_flange_board, float(rig.camera.K[0, 0]))
    return [views[i] for i in greedy(view_design(places, rig.T_world_camera), rows, count)]


def about_camera(views: list[PlannedView], count: int, seed: int) -> list[PlannedView]:
    """All `views`, those `count` first whose motions turn about a point near the camera.

    Between any two views the board moves by a rotation about some place. If the board is printed
    larger than stated by a share s, a closed form shifts the camera by s times its distance from
    the place that all these motions have nearest in common: with p' = R p + t, that is the least-
    squares solution p of (I - R) p = t over all pairs. Of SUBSETS random sets the one with the
    nearest such place is taken; along the camera's axis it matters less, because there the plane
    map feels only a change of size. Only the half of the sets with the more varied tilts counts:
    hand-eye needs rotations about two axes before all else.
    """
    if len(views) <= count:
        return list(views)
    poses = np.array([view.T_camera_board for view in views])
    motions = poses[:, None] @ invert(poses)[None]
    A, t = np.eye(3) - motions[..., :3, :3], motions[..., :3, 3]
    normal = np.einsum("ijba,ijbc->ijac", A, A) + RIDGE * np.eye(3)
    right = np.einsum("ijba,ijb->ija", A, t)
    rng = np.random.default_rng(seed)
    drawn = [rng.permutation(len(views)) for _ in range(SUBSETS)]
    varied = np.array([_variety(poses[order[:count], :2, 2]) for order in drawn])
    drawn = [drawn[i] for i in np.flatnonzero(varied >= np.median(varied))]
    best = min(drawn, key=lambda order: _distance(normal, right, order[:count]))
    return [views[i] for i in best]


def _variety(tilts: Array) -> float:
    """How far the tilts (n, 2) are scattered about the direction in which they are least so."""
    return float(np.linalg.svd(tilts - tilts.mean(axis=0), compute_uv=False)[-1])


def _distance(normal: Array, right: Array, chosen: Array) -> float:
    """How far, in metres, the motions' common place is from the camera."""
    pairs = np.ix_(chosen, chosen)
    x, y, z = np.linalg.solve(normal[pairs].sum(axis=(0, 1)), right[pairs].sum(axis=(0, 1)))
    return float(np.hypot(x, y) + DEPTH_WEIGHT * abs(z))
