"""What can be asked of a cell, by name. Each procedure is plan -> collect -> solve -> judge."""

from cellctl.procedures import full, hand_eye, intrinsic, projector
from cellctl.run import Procedure

PROCEDURES: dict[str, Procedure] = {
    module.PROCEDURE.name: module.PROCEDURE for module in (intrinsic, hand_eye, projector, full)
}
