"""What a run recorded, as the pure part of a procedure takes it: online from the journal, offline
from the journal and the pictures on disk."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from pydantic import BaseModel

from cellctl.config import CellConfig
from cellctl.run import Run
from cellctl.store.history import Sample

Params = TypeVar("Params", bound=BaseModel)
Samples = Mapping[str, Sample]


@dataclass(frozen=True, eq=False)
class Record(Generic[Params]):
    """`steps` holds samples by `<scope>/<step>`; `active` is the calibration that was active.

    With `again` detections are made anew in the pictures; else the journalled ones are taken.
    """

    config: CellConfig
    params: Params
    active: Mapping[str, Any] | None
    steps: Mapping[str, Samples]
    again: bool = False

    def samples(self, step: str) -> Samples:
        """The samples of a step; none when it was not reached."""
        return self.steps.get(step, {})

    def scoped(self, scope: str, params: Any) -> Record[Any]:
        """The part that a chained procedure recorded, with its own parameters."""
        prefix = f"{scope}/"
        steps = {
            name.removeprefix(prefix): samples
            for name, samples in self.steps.items()
            if name.startswith(prefix)
        }
        return Record(self.config, params, self.active, steps, self.again)


def recorded(run: Run, config: CellConfig, params: Params) -> Record[Params]:
    """What `run` has recorded so far."""
    return Record(config, params, run.calibration, run.all_samples())
