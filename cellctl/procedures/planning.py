"""Planning of views: which poses of a board, held before a camera, make a good sweep.

Candidates are drawn in front of the camera, solved for the arm, and kept when the guard allows
them, the whole board is in the picture and nothing of the arm hides it. From what is left a
spread-out set is picked: extremes first, so that corners of the image and steep tilts come in.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from cellctl import ik
from cellctl.arms import JOINTS
from cellctl.drivers.base import Path
from cellctl.geometry import Array, Mask, invert, transform_points
from cellctl.motion import Guard
from cellctl.procedures.choice import about_camera, features, spread_out
from cellctl.procedures.rig import PlannedView, Rig
from cellctl.procedures.routing import Roadmap, connect, nearest_first, shortened

IK_STARTS = 12
OCCLUSION_GRID = 5
SEARCH_CANDIDATES = 250
SEARCH_CHOICES = 24
CONNECT_TRIES = 5
HUBS_TRIED = 12
BRIDGES = 2
NOWHERE = np.empty((0, JOINTS))
ENOUGH_CHOICE, CHOICE_PER_VIEW = 60, 6
CANDIDATES, CANDIDATES_PER_VIEW = 400, 12
PLACING_ROUNDS = 3
"""Where a board appears depends on where it is: so often is its place in the picture put right."""
BATCHES = 3
GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))
NEAR_M = 0.01
"""Closer to the camera than this nothing is looked at."""
MORE_DRAWS = 2
MOST_OF_PICTURE = 0.65
"""Share of the play in the picture that boards which are to fill it use at least."""
SPIRAL_STEP = 0.07
"""Radius of the search spiral's first point, in image widths."""


@dataclass(frozen=True)
class Spread:
    """What candidates look like. Tilts in degrees about an axis in the image plane; `fill` is
    the share of the image's width that the board's longer side may take; `spin_deg` turns it in
    its own plane. `middle` is the share of the picture that boards are spread over, `to_the_edges`
    says that it matters, see `attainable`. A sweep draws `draws` times as many candidates, and
    keeps `postures` of the arm for each. `about_camera` picks views for hand-eye, see
    `choice.about_camera`."""

    tilt_deg: tuple[float, float] = (20.0, 45.0)
    spin_deg: float = 60.0
    fill: tuple[float, float] = (0.22, 0.42)
    middle: float = 1.0
    to_the_edges: bool = False
    edge_px: float = 12.0
    draws: int = 1
    postures: int = 8
    about_camera: bool = False


def attainable(spread: Spread, rig: Rig, guard: Guard) -> Spread:
    """The spread as far as the arm can come near to the camera, which the workspace box tells.

    Where it cannot come as near as the largest `fill` asks for, all of `fill` is scaled down to
    what a board fills in the box's nearest corner. Boards stay as much nearer to the middle of
    the picture, under which the table is, but for those that are to fill it. No motion turns about
    a point near the camera then, so views are not picked for that. More candidates are drawn, for
    most are out of reach, and one posture of each is enough.
    """
    corners = itertools.product(*zip(guard.scene.box_low, guard.scene.box_high, strict=True))
    depths = transform_points(invert(rig.T_world_camera), np.array(list(corners)))[:, 2]
    side = np.ptp(rig.outline, axis=0).max()
    largest = rig.camera.K[0, 0] * side / (max(depths.min(), NEAR_M) * rig.camera.image_size[0])
    low, high = spread.fill
    share = min(largest / high, 1.0)
    if share == 1.0:
        return spread
    middle = max(share, MOST_OF_PICTURE) if spread.to_the_edges else share
    return replace(
        spread,
        fill=(low * share, largest),
        middle=middle * spread.middle,
        draws=MORE_DRAWS,
        postures=1,
        about_camera=False,
    )


def candidates(rig: Rig, spread: Spread, count: int, seed: int) -> Array:
    """T_camera_board (count, 4, 4) before the camera, not yet checked against anything.

    The board lies where it is wholly in the picture, over the share `middle` of the play that it
    has there, more often at the ends of it (arcsine distribution): distortion shows there. All
    quarter turns are tried, tilts are about axes of every direction.
    """
    rng = np.random.default_rng(seed)
    size = np.array(rig.camera.image_size)
    side = np.ptp(rig.outline, axis=0).max()
    depth = rig.camera.K[0, 0] * side / (rng.uniform(*spread.fill, count) * size[0])
    share = 0.5 + 0.5 * np.sin(np.pi * rng.uniform(-0.5, 0.5, (count, 2))) * spread.middle
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = _turns(spread, count, rng)
    arm = poses[:, :3, :3] @ np.array([*rig.outline.mean(axis=0), 0.0])
    middle = np.tile(size / 2, (count, 1))
    for _ in range(PLACING_ROUNDS):
        rays = np.column_stack([rig.camera.normalise(middle), np.ones(count)])
        poses[:, :3, 3] = rays * depth[:, None] - arm
        pixels = rig.camera.project(rig.board_points(poses))
        low, high = pixels.min(axis=1), pixels.max(axis=1)
        play = size - 1 - 2 * spread.edge_px - (high - low)
        middle += spread.edge_px + share * play - low
    return poses


def _turns(spread: Spread, count: int, rng: np.random.Generator) -> Array:
    tilt = np.radians(rng.uniform(*spread.tilt_deg, count))
    about = rng.uniform(0.0, 2 * np.pi, count)
    spin = np.radians(rng.uniform(-spread.spin_deg, spread.spin_deg, count))
    spin += rng.integers(0, 4, count) * np.pi / 2
    axis = np.column_stack([np.cos(about), np.sin(about), np.zeros(count)])
    turned = Rotation.from_rotvec(axis * tilt[:, None]) * Rotation.from_euler("z", spin[:, None])
    return turned.as_matrix()


def visible(rig: Rig, T_camera_board: Array, edge_px: float) -> Mask:
    """Whether the whole board (n,) lies in the picture, `edge_px` from its border, in front of
    the camera and seen from its printed side at less than 60 degrees."""
    points = rig.board_points(T_camera_board, 3)
    in_front = (points[..., 2] > 0.05).all(axis=1)
    safe = np.where(points[..., 2:] > 0.05, points, (0.0, 0.0, 1.0))
    pixels = rig.camera.project(safe)
    inside = (pixels > edge_px) & (pixels < np.array(rig.camera.image_size) - 1 - edge_px)
    middle = points.mean(axis=1)
    incidence = (T_camera_board[:, :3, 2] * middle).sum(axis=1) / np.linalg.norm(middle, axis=1)
    return in_front & inside.all(axis=(1, 2)) & (incidence > 0.5)


def unhidden(rig: Rig, guard: Guard, T_camera_board: Array, joints: Array) -> Mask:
    """Whether no link of the arm and no pen stands between the camera and the board (n,)."""
    bodies = [b for b in guard.bodies if b.name.startswith("link") or b.name == "pen"]
    centres, radii = guard.spheres(joints, bodies)
    centres = transform_points(invert(rig.T_world_camera), centres)
    points = rig.board_points(T_camera_board, OCCLUSION_GRID)
    return ~_blocked(points, centres, radii)


def _blocked(points: Array, centres: Array, radii: Array) -> Mask:
    """Whether any sphere (n, m) touches any segment from the origin to points (n, k, 3)."""
    length2 = (points**2).sum(axis=-1)
    along = np.einsum("nkj,nmj->nkm", points, centres) / length2[..., None]
    nearest = points[:, :, None] * np.clip(along, 0.0, 1.0)[..., None]
    distance = np.linalg.norm(nearest - centres[:, None], axis=-1)
    return (distance < radii).any(axis=(1, 2))


def feasible(
    rig: Rig,
    guard: Guard,
    T_camera_board: Array,
    near: Array,
    edge_px: float,
    postures: int = Spread.postures,
) -> list[PlannedView]:
    """The views that can be shown: in the picture, reachable, allowed by the guard, not hidden.

    The same view may come up to `postures` times, with different arm configurations; those nearest
    to the posture `near` (6,) come first.
    """
    seen = T_camera_board[visible(rig, T_camera_board, edge_px)]
    seen = seen[guard.arm.may_reach(rig.flange(seen)[:, :3, 3])]
    starts = np.vstack([near, ik.random_starts(guard.arm, IK_STARTS, seed=7)])
    found = ik.solutions(guard.arm, rig.flange(seen), near, starts)
    owner = np.repeat(np.arange(len(seen)), [len(joints) for joints in found])
    if not len(owner):
        return []
    joints = np.concatenate(found)
    good = guard.free(joints)
    good[good] = unhidden(rig, guard, seen[owner[good]], joints[good])
    owner, joints = owner[good], joints[good]
    rank = np.arange(len(owner)) - np.searchsorted(owner, owner)
    chosen = np.flatnonzero(rank < postures)
    return [PlannedView(seen[owner[i]], joints[i]) for i in chosen]


def search_views(
    rig: Rig, guard: Guard, here: Array, step: int, had: Array, edge_px: float, seed: int
) -> list[PlannedView]:
    """Views worth trying next while the board's place is hardly known, best first.

    Until the board was seen (`had` (n, 4, 4) is empty) the board is shown flat, on a spiral that
    widens with `step` from the middle of the picture; afterwards tilted, and as different as
    possible from the views `had`.
    """
    if not len(had):
        flat = Spread(tilt_deg=(0.0, 20.0), spin_deg=180.0, fill=(0.16, 0.28), middle=0.9)
        flat = attainable(flat, rig, guard)
        drawn = candidates(rig, flat, SEARCH_CANDIDATES, seed)
        views = feasible(rig, guard, drawn, here, edge_px, flat.postures)
        return sorted(views, key=lambda view: _from_spiral(rig, view, step))
    steep = min(15.0 + 5.0 * len(had), 35.0)
    tilted = Spread(tilt_deg=(0.6 * steep, steep), fill=(0.18, 0.32), middle=0.5)
    tilted = attainable(tilted, rig, guard)
    drawn = candidates(rig, tilted, SEARCH_CANDIDATES, seed)
    views = feasible(rig, guard, drawn, here, edge_px, tilted.postures)
    if not views:
        return []
    new = features(rig, np.array([view.T_camera_board for view in views]))
    gap = np.linalg.norm(new[:, None] - features(rig, had), axis=2).min(axis=1)
    return [views[i] for i in np.argsort(-gap, kind="stable")]


def _from_spiral(rig: Rig, view: PlannedView, step: int) -> float:
    """Distance of the board's middle from point `step` of a spiral (Vogel 1979), in widths."""
    width, height = rig.camera.image_size
    angle, radius = step * GOLDEN_ANGLE, SPIRAL_STEP * np.sqrt(step)
    point = np.array([width / 2, height / 2]) + radius * width * np.array(
        [np.cos(angle), np.sin(angle)]
    )
    middle = rig.camera.project(rig.board_points(view.T_camera_board[None]).mean(axis=1))[0]
    return float(np.linalg.norm(middle - point) / width)


def plan_sweep(
    rig: Rig, guard: Guard, here: Array, spread: Spread, count: int, seed: int
) -> list[PlannedView]:
    """Up to `count` spread-out views in visiting order, then up to as many spares.

    All can be reached from `here` (6,) over lines that the guard allows.
    """
    guard, spread = guard.cautious(here), attainable(spread, rig, guard)
    reached = _reachable_views(rig, guard, here, spread, count, seed)
    if spread.about_camera:
        chosen = about_camera(spread_out(rig, reached, 3 * count), count, seed)[: 2 * count]
    else:
        chosen = spread_out(rig, reached, 2 * count)
    main, spares = chosen[:count], chosen[count:]
    if not main:
        return []
    order = nearest_first(here, np.array([view.joints for view in main]))
    return [main[i] for i in order] + spares


def _reachable_views(
    rig: Rig, guard: Guard, here: Array, spread: Spread, count: int, seed: int
) -> list[PlannedView]:
    """A choice to pick `count` views from: candidates are drawn, and paths to them searched,
    until it is large or drawing more is no use."""
    enough = max(2 * count, min(ENOUGH_CHOICE, CHOICE_PER_VIEW * count))
    views: list[PlannedView] = []
    road = Roadmap(guard, here, np.empty((0, JOINTS)))
    for batch in range(BATCHES):
        number = spread.draws * (CANDIDATES + CANDIDATES_PER_VIEW * count)
        drawn = candidates(rig, spread, number, seed + batch)
        found = feasible(rig, guard, drawn, here, spread.edge_px, spread.postures)
        views += found
        road.add(np.array([view.joints for view in found]).reshape(-1, JOINTS))
        bridged = BRIDGES
        while len(_different(views, road)) < 2 * count and bridged:
            bridged = bridged - 1 if road.bridge() else 0
        if len(_different(views, road)) >= enough:
            break
    return _different(views, road)


def _different(views: list[PlannedView], road: Roadmap) -> list[PlannedView]:
    """The views that were reached, each with one of its arm configurations."""
    first = {views[i].T_camera_board.tobytes(): i for i in sorted(road.index, reverse=True)}
    return [views[i] for i in sorted(first.values())]


def first_reached(
    guard: Guard, here: Array, views: list[PlannedView], hubs: Array
) -> tuple[PlannedView, Path] | None:
    """The first of `views` that an allowed path leads to from `here`, and that path, if need be
    over other views or over the postures `hubs` (n, 6)."""
    if views and guard.allows(here, direct := Path(views[0].joints[None])):
        return views[0], direct
    joints = np.array([view.joints for view in views]).reshape(-1, JOINTS)
    road = Roadmap(guard, here, np.vstack([joints, hubs]))
    reached = [i for i in sorted(road.index) if i < len(views)]
    if reached:
        return views[reached[0]], road.path(here, road.index[reached[0]])
    for view in views[:CONNECT_TRIES]:
        path = connect(guard, here, view.joints)
        if path is not None:
            return view, path
    return None


def reach(guard: Guard, here: Array, way: Array, hubs: Array, came: Array = NOWHERE) -> Path | None:
    """An allowed path from `here` to the end of `way` (n, 6), if need be over `hubs` (m, 6), or
    back over the postures `came` (k, 6) which the arm has come by, oldest first.

    Tried in this order, the quickest to find first: straight, by the way as it was planned, over
    one hub, back where the arm came from, over several hubs, by RRT-Connect, by RRT-Connect to
    hubs and over these.
    """
    goal = way[-1]
    direct, planned = Path(goal[None]), Path(way)
    cautious = guard.cautious(here, goal)
    if cautious.allows(here, direct):
        return direct
    if guard.allows(here, planned):
        return planned
    return (
        _over_one(guard, here, goal, hubs)
        or retrace(guard, here, goal, came)
        or _over_several(cautious, here, goal, hubs)
        or _searched(cautious, here, goal, hubs)
    )


def _over_one(guard: Guard, here: Array, goal: Array, hubs: Array) -> Path | None:
    legs = np.abs(hubs - here).max(axis=1) + np.abs(hubs - goal).max(axis=1)
    for hub in hubs[np.argsort(legs, kind="stable")[:HUBS_TRIED]]:
        detour = Path(np.array([hub, goal]))
        if guard.allows(here, detour):
            return detour
    return None


def _over_several(guard: Guard, here: Array, goal: Array, hubs: Array) -> Path | None:
    road = Roadmap(guard, here, np.vstack([goal[None], hubs]), until=0)
    return road.path(here, road.index[0]) if 0 in road.index else None


def _searched(guard: Guard, here: Array, goal: Array, hubs: Array) -> Path | None:
    found = connect(guard, here, goal)
    road = Roadmap(guard, here, np.vstack([goal[None], hubs]), until=0) if found is None else None
    for _ in range(BRIDGES):
        if road is not None and road.bridge() and 0 in road.index:
            return road.path(here, road.index[0])
    return found


def retrace(guard: Guard, here: Array, goal: Array, came: Array) -> Path | None:
    """From `here` back over the postures `came` (n, 6), oldest first, to the last one from which
    a straight line leads to `goal`. For arms that have gone to where no search finds a way out."""
    cautious = guard.cautious(here, goal)
    for i in reversed(range(len(came))):
        if cautious.allows(came[i], Path(goal[None])):
            back = np.vstack([here, came[i:][::-1], goal])
            if not guard.allows(here, Path(back[1:])):
                return None
            return Path(shortened(cautious, back, seed=i)[1:])
    return None
