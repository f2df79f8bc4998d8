"""How long a picture of the simulated camera takes: `python benchmarks/render.py [--frames N]`.

Every frame differs from the one before, so that nothing can be used again:

- table: a new picture on the glass, the arm out of sight
- board: the arm holds its boards over the table, somewhere else each time; the projector is dark
- lit board: the same in the light of a new picture
- moving board: an exposure of a moving arm, blurred
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from cellctl.sim.light import Light, Picture
from cellctl.sim.optics import Instant, Renderer
from cellctl.sim.presets import PRESETS
from cellctl.sim.truth import Truth, draw

DARK: Light = ((1.0, None),)
POSTURES = {
    "cr": (-76.0, -84.0, -111.0, -75.0, 90.0, -166.0),
    "ir": (11.0, -8.0, 14.0, 0.0, -96.0, -11.0),
}
"""Degrees: boards over the table, facing the camera."""
MOVING_INSTANTS = 12


def scenes(truth: Truth) -> dict[str, Callable[[int], tuple[Instant, ...]]]:
    """What the i-th frame of each scene is an exposure of."""
    preset = truth.preset
    home, posture = np.radians(preset.home_deg), np.radians(POSTURES[preset.name])

    def light(i: int) -> Light:
        width, height = preset.projector.size_px
        rng = np.random.default_rng(i)
        coarse = rng.integers(0, 2, (height // 40, width // 40), dtype=np.uint8) * 255
        return ((1.0, Picture(np.kron(coarse, np.ones((40, 40), dtype=np.uint8)))),)

    def at(joints: np.ndarray, i: int, step: float = 0.01) -> np.ndarray:
        return truth.arm.link_frames(joints + step * np.sin(i + np.arange(6)))

    def moving(i: int) -> tuple[Instant, ...]:
        share = 1.0 / MOVING_INSTANTS
        steps = np.linspace(0.0, 0.01, MOVING_INSTANTS)
        return tuple(Instant(share, at(posture + step, i), DARK) for step in steps)

    return {
        "table": lambda i: (Instant(1.0, truth.arm.link_frames(home), light(i)),),
        "board": lambda i: (Instant(1.0, at(posture, i), DARK),),
        "lit board": lambda i: (Instant(1.0, at(posture, i), light(i)),),
        "moving board": moving,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cell", choices=sorted(POSTURES), default="cr")
    parser.add_argument("--frames", type=int, default=40)
    arguments = parser.parse_args()
    preset = PRESETS[arguments.cell]
    truth = draw(preset, 0)
    renderer = Renderer(truth.seed, preset.camera)
    width, height = preset.camera.size_px
    print(f"{preset.name}: {width} x {height}, {arguments.frames} frames each, ms a frame")
    for name, scene in scenes(truth).items():
        renderer.picture(truth, scene(arguments.frames), "warm")
        took = []
        for i in range(arguments.frames):
            instants = scene(i)
            began = time.perf_counter()
            renderer.picture(truth, instants, f"{i}")
            took.append(1e3 * (time.perf_counter() - began))
        p50, p99 = np.percentile(took, [50, 99])
        print(f"  {name:<14} p50 {p50:6.1f}   p99 {p99:6.1f}")


if __name__ == "__main__":
    main()
