"""How fast the adjustments are, as ratios within one run.

    python -m benchmarks.solvers

A camera from 40 views: ours, cv2.calibrateCamera, SciPy's least_squares with our derivatives, all
to the same optimum, whose costs are printed. The joint adjustment of a run of the paper's size.
Adjustments of up to 2000 views. Exit code 1 when ours is slower than OpenCV, the joint adjustment
takes more than five times as long as the camera's, or time grows faster than the views.
"""

from __future__ import annotations

import os

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import sys
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from scipy.optimize import least_squares

from cellctl.calib.camera_fit import CameraOption, start_camera
from cellctl.calib.chain import Chain, ChainState, Sheet
from cellctl.calib.joint.solve import HUBER, solve_joint
from cellctl.calib.joint.start import JointOptions, begin
from cellctl.calib.schur import minimise
from cellctl.calib.views import Batch, View
from cellctl.geometry import Array
from tests.calib.joint_world import joint_world
from tests.calib.synthetic import CAMERA, views

VIEWS, REPEATS = 40, 7
LONG = (40, 200, 1000, 2000)
JOINT, SAME, LINEAR = 5.0, 1e-4, 1.25
"""Limits: times the camera's adjustment; relative difference of costs; of the time a view takes,
the most against the fewest views."""
OPTION = CameraOption(warp=False)
CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)


def best(*functions: Callable[[], Any], repeats: int = REPEATS) -> tuple[list[float], list[Any]]:
    """The least seconds of each, in turns so that a busy machine is fair, and what they return."""
    seconds, found = [np.inf] * len(functions), [None] * len(functions)
    for _ in range(repeats):
        for i, function in enumerate(functions):
            begun = time.perf_counter()
            found[i] = function()
            seconds[i] = min(seconds[i], time.perf_counter() - begun)
    return seconds, found


def problem(seen: list[View]) -> tuple[Chain, ChainState]:
    """Of the camera alone, at the start that we make ourselves."""
    camera, poses = start_camera(seen, CAMERA.image_size)
    matrices = np.stack([poses[view.id] for view in seen])
    ones = np.broadcast_to(np.eye(4), matrices.shape)
    sheet = Sheet.of(np.concatenate([view.points for view in seen]))
    chain = Chain(Batch.of(seen), ones, ones, sheet, OPTION.free)
    return chain, ChainState(camera, np.eye(4), np.eye(4), matrices)


def opencv(seen: list[View]) -> float:
    """Its cost."""
    points = [view.points.astype(np.float32) for view in seen]
    pixels = [view.pixels.astype(np.float32) for view in seen]
    rms, *_ = cv2.calibrateCamera(points, pixels, CAMERA.image_size, None, None, criteria=CRITERIA)
    return 0.5 * float(rms) ** 2 * sum(len(view.points) for view in seen)


def scipy_dense(chain: Chain, start: ChainState) -> float:
    """Its cost: dense derivatives, the same start; the state moves from the start by x."""
    count, n = chain.free.count, len(start.corrections)

    def state(x: Array) -> ChainState:
        return chain.retract(start, x[:count], x[count:].reshape(n, 6))

    def jacobian(x: Array) -> Array:
        """By the unknowns about `x`, which is as good as about the start for a small step."""
        linear = chain.linearise(state(x))
        _, G, L = linear.rows
        dense = np.zeros((n, G.shape[1], count + 6 * n))
        dense[..., :count] = G
        for i in range(n):
            dense[i, :, count + 6 * i : count + 6 * i + 6] = L[i]
        return dense.reshape(-1, count + 6 * n)

    found = least_squares(
        lambda x: chain.residuals(state(x)).reshape(-1),
        np.zeros(count + 6 * n),
        jacobian,
        x_scale="jac",
        ftol=1e-10,
    )
    return float(found.cost)


def camera_only() -> tuple[float, list[str]]:
    """Milliseconds of our adjustment, and what is wrong."""
    seen = views(1, VIEWS, noise=0.07)
    chain, start = problem(seen)
    (ours, whole, theirs), (solution, _, cost) = best(
        lambda: minimise(chain, start),
        lambda: minimise(*problem(seen)),
        lambda: opencv(seen),
    )
    (slow,), (dense,) = best(lambda: scipy_dense(chain, start), repeats=1)
    rows = (
        ("ours, the adjustment", ours, solution.cost),
        ("ours, from pixels alone", whole, solution.cost),
        ("cv2.calibrateCamera", theirs, cost),
        ("scipy least_squares, our derivatives, dense", slow, dense),
    )
    print(f"a camera from {VIEWS} views{'ms':>37} {'of cv2':>8} {'cost':>12}")
    for name, seconds, value in rows:
        print(f"  {name:<48} {1e3 * seconds:8.1f} {seconds / theirs:8.2f} {value:12.5f}")
    wrong = [] if whole <= theirs else ["slower than cv2.calibrateCamera"]
    if abs(solution.cost / cost - 1.0) > SAME:
        wrong.append("not the same optimum as cv2.calibrateCamera")
    return ours, wrong


def joint(camera_s: float) -> list[str]:
    world = joint_world(0)
    problem, state = begin(world.seen, world.start, JointOptions(), world.area)
    (one, all_), (solution, result) = best(
        lambda: minimise(problem, state, huber=HUBER, tolerance=1e-6),
        lambda: solve_joint(world.seen, world.start, area=world.area),
        repeats=3,
    )
    print(
        f"\nall of a run: 30 + 10 views, {len(world.seen.markers)} markers, "
        f"{len(world.seen.circles)} circles; {result.layout.count} unknowns and 6 a view"
    )
    for name, seconds in (
        (f"the adjustment, {solution.iterations} steps", one),
        ("with start, and noises estimated", all_),
    ):
        ratio = seconds / camera_s
        print(f"  {name:<48} {1e3 * seconds:8.1f}   {ratio:.1f} times the camera's")
    return [] if one <= JOINT * camera_s else [f"the joint adjustment: {one / camera_s:.1f} times"]


def growing() -> list[str]:
    print("\nviews, ms, ms a view")
    each = []
    for count in LONG:
        chain, start = problem(views(2, count, noise=0.07))
        (seconds,), _ = best(lambda c=chain, s=start: minimise(c, s), repeats=2)  # type: ignore[misc]
        each.append(seconds / count)
        print(f"  {count:5} {1e3 * seconds:8.1f} {1e3 * seconds / count:8.3f}")
    return [] if each[-1] <= LINEAR * each[0] else ["time grows faster than the views"]


def main() -> int:
    cv2.setNumThreads(1)
    camera_s, wrong = camera_only()
    wrong += joint(camera_s) + growing()
    for line in wrong:
        print(f"  too slow: {line}" if "optimum" not in line else f"  {line}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
