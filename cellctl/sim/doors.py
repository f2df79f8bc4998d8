"""What each door of the simulated cell answers.

`cell` is the cell as its drivers see it, `truth` is for scoring only, `faults` plants faults in
tests.
"""

from __future__ import annotations

from typing import Any

from pydantic import ValidationError

from cellctl.errors import BadInput, NotFound
from cellctl.explain import explain
from cellctl.sim import cell_door, fault_door, truth_door
from cellctl.sim.session import Answer, Door, Session

DOORS: dict[str, Door] = {
    "cell": cell_door.DOOR,
    "truth": truth_door.DOOR,
    "faults": fault_door.DOOR,
}


async def answer(door: str, session: Session, header: dict[str, Any], blob: bytes) -> Answer:
    """Check a request and carry it out. BadInput names what is wrong with it."""
    verbs = DOORS[door]
    verb = header.get("verb")
    if not isinstance(verb, str) or verb not in verbs:
        raise NotFound(f"door {door!r} knows no verb {verb!r}; known: {', '.join(sorted(verbs))}")
    kind, handler = verbs[verb]
    try:
        request = kind.model_validate(header)
    except ValidationError as error:
        raise BadInput(f"{verb}: {explain(error, kind, most=5)}") from None
    session.blob = blob
    session.cell.pace.now()
    return await handler(session, request)
