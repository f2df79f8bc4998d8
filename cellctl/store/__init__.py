"""Runs and calibrations on disk: journal, atomic files, recovery, promotion."""

from cellctl.store.store import Store

__all__ = ["Store"]
