"""The first screen: what came of the run, in words, and the few figures that matter."""

from __future__ import annotations

from dataclasses import dataclass

from cellctl.report.odd import at, count, number, rows, text, texts
from cellctl.report.phrases import NONE, date, duration, figure, interval, plural
from cellctl.report.recorded import Recorded

WORDS = {
    "running": ("RUNNING", "wait"),
    "waiting": ("WAITING", "wait"),
    "failed": ("FAILED", "bad"),
    "cancelled": ("CANCELLED", "wait"),
    "abandoned": ("ABANDONED", "wait"),
    "interrupted": ("INTERRUPTED", "wait"),
}
SENTENCES = {
    "running": "The run was still going on when this report was written.",
    "waiting": "The run was waiting for an operator when this report was written.",
    "failed": "The run ended with an error before it came to a result. It calibrated nothing; the "
    "calibration that was in use before is untouched.",
    "cancelled": "The run was cancelled before it came to a result. What it recorded until then "
    "is below.",
    "abandoned": "The run was interrupted and then given up. What it recorded until then is below.",
    "interrupted": "The run was interrupted before it came to a result. Nothing that it recorded "
    "is lost, and it can be resumed.",
}


@dataclass(frozen=True)
class Verdict:
    """`tone` is good, bad or wait. `figures` are (value, unit, what it is, remark)."""

    word: str
    tone: str
    sentence: str
    reasons: list[str]
    figures: list[tuple[str, str, str, str]]
    facts: list[tuple[str, str]]


def verdict_of(recorded: Recorded) -> Verdict:
    """How the run ended."""
    word, tone, sentence = _outcome(recorded)
    return Verdict(word, tone, sentence, _reasons(recorded), _figures(recorded), _facts(recorded))


def _outcome(recorded: Recorded) -> tuple[str, str, str]:
    standing = recorded.standing
    if not recorded.entries:
        return "UNKNOWN", "bad", "The journal cannot be read, so how the run ended is not known."
    if standing.status != "done":
        word, tone = WORDS[standing.status]
        return word, tone, SENTENCES[standing.status]
    judged = standing.verdict or recorded.result.get("verdict")
    if judged == "pass":
        return "PASS", "good", _passed(recorded)
    if judged == "fail":
        return "FAIL", "bad", _failed(recorded)
    return "DONE", "wait", "The run has finished; it says nothing about how good its result is."


def _passed(recorded: Recorded) -> str:
    evaluated = recorded.part("evaluate")
    mm = number(evaluated.get("held_out_mm"))
    if mm is None:
        name = text(recorded.header.procedure)
        return f"Every check of {name} passed; its figures are within their limits."
    circles = count(evaluated.get("circles"))
    seen = f"{plural(circles, 'circle')} that no fit has seen" if circles else "circles held out"
    sure = interval(evaluated.get("held_out_ci_mm"))
    range_of = f" (95\N{NO-BREAK SPACE}% interval {sure} mm)" if sure else ""
    return (
        "The cell is calibrated. Projected light misses the point that the robot means by "
        f"{figure(mm)} mm RMS{range_of}, measured on {seen}."
    )


def _failed(recorded: Recorded) -> str:
    active = recorded.header.active_calibration
    kept = (
        f"{text(active)}, which was in use before, stays in use."
        if active
        else "No calibration was in use before, and none is now."
    )
    return f"The run has finished, but its result is not good enough to be used. {kept}"


def _reasons(recorded: Recorded) -> list[str]:
    standing = recorded.standing
    reasons = texts(standing.reasons) or texts(recorded.result.get("reasons"))
    for more in (standing.error, standing.fault):
        if more and text(more) not in reasons:
            reasons.append(text(more))
    if standing.question is not None:
        reasons.append(f"It asks: {text(standing.question.text)}")
    return reasons


def _figures(recorded: Recorded) -> list[tuple[str, str, str, str]]:
    evaluated = recorded.part("evaluate")
    found: list[tuple[str, str, str, str]] = []
    sure = interval(evaluated.get("held_out_ci_mm"))
    for unit in ("mm", "px"):
        if (value := number(evaluated.get(f"held_out_{unit}"))) is not None:
            sure_of_it = f"95\N{NO-BREAK SPACE}%: {sure} mm" if sure and unit == "mm" else ""
            remark = sure_of_it or ("projector pixels" if unit == "px" else "")
            found.append((figure(value), unit, "held-out error", remark))
    truth = at(recorded.truth, "final")
    if (value := number(at(truth, "true_mm"))) is not None:
        found.append((figure(value), "mm", "true error", "known only in simulation"))
    return found or _part_figures(recorded)


def _part_figures(recorded: Recorded) -> list[tuple[str, str, str, str]]:
    """Held-out pixels of each part, when nothing was drawn that would tell millimetres."""
    found = []
    for part in ("intrinsic", "hand-eye", "projector"):
        if (value := number(recorded.part(part).get("held_out_px"))) is not None:
            pixels = "projector pixels" if part == "projector" else "camera pixels"
            found.append((figure(value), "px", f"{part}, held out", pixels))
    return found


def _facts(recorded: Recorded) -> list[tuple[str, str]]:
    header, standing = recorded.header, recorded.standing
    simulated = " (simulated)" if at(recorded.config, "simulation") else ""
    facts = [
        ("procedure", text(header.procedure)),
        ("cell", f"{text(header.cell)}{simulated}"),
        ("started", date(header.created)),
        ("duration", duration(recorded.seconds())),
        ("samples", str(standing.samples)),
        ("run", text(header.run_id)),
        ("calibration", text(standing.calibration_id) or "none came of this run"),
    ]
    circles = rows(recorded.part("draw"), "circles")
    if circles:
        facts.insert(5, ("circles drawn", str(len(circles))))
    return [(name, value or NONE) for name, value in facts]
