"""One run at a time on one cell: the engine, and what happens to a run that is active."""

from cellctl.engine.engine import Engine

__all__ = ["Engine"]
