"""The projector: when what is shown reaches the glass, and what is on it at any time."""

from __future__ import annotations

from cellctl.drivers.base import Image
from cellctl.sim.light import Light, Picture
from cellctl.sim.noise import keyed
from cellctl.sim.presets import ProjectorPreset

SHORTEST_LATENCY_S = 0.004


class Glass:
    """The history of what is on the glass; dark at first. Pictures arrive in their order."""

    def __init__(self, seed: int, preset: ProjectorPreset, t: float) -> None:
        self._seed, self._preset = seed, preset
        self._history: list[tuple[float, Picture | None]] = [(t, None)]
        self._wanted: Picture | None = None
        self._lit = True

    def show(self, now: float, image: Image, index: str) -> None:
        self._wanted = Picture(image)
        if self._lit:
            self._put(now + self._latency(index), self._wanted)

    def switch(self, now: float, *, on: bool) -> None:
        """Lamp off: dark at once. Lamp on: what was shown last appears."""
        self._lit = on
        if on:
            self._put(now, self._wanted)
        else:
            self._history = [entry for entry in self._history if entry[0] <= now]
            self._put(now, None)

    def between(self, start: float, end: float) -> Light:
        """What was on the glass from `start` to `end`, with the share of that time."""
        edges = [t for t, _ in self._history[1:]] + [float("inf")]
        parts = [
            (max(min(until, end) - max(since, start), 0.0), picture)
            for (since, picture), until in zip(self._history, edges, strict=True)
        ]
        total = sum(duration for duration, _ in parts)
        if total == 0.0:  # before the world began
            return ((1.0, self._history[0][1]),)
        return tuple((duration / total, p) for duration, p in parts if duration > 0.0)

    def forget(self, before: float) -> None:
        while len(self._history) > 1 and self._history[1][0] < before:
            del self._history[0]

    def _latency(self, index: str) -> float:
        rng = keyed(self._seed, "glass", index)
        drawn = rng.normal(self._preset.latency_s, self._preset.latency_sigma_s)
        return max(float(drawn), SHORTEST_LATENCY_S)

    def _put(self, t: float, picture: Picture | None) -> None:
        self._history.append((max(t, self._history[-1][0]), picture))
