"""What can be asked of a cell, by name. Each procedure is plan -> collect -> solve -> judge."""

from cellctl.procedures import (
    draw,
    evaluate,
    full,
    hand_eye,
    intrinsic,
    measure_table,
    projector,
    refine,
    tcp,
)
from cellctl.run import Procedure

PARTS = (intrinsic, hand_eye, projector, measure_table, tcp, draw, refine, evaluate, full)
PROCEDURES: dict[str, Procedure] = {part.PROCEDURE.name: part.PROCEDURE for part in PARTS}
