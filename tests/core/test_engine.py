"""The engine: what starts, what is refused, how runs end, and what a person is left with."""

from __future__ import annotations

import asyncio
import json
import os

import pytest
import structlog

from cellctl.engine.bulletin import KEPT, Bulletin
from cellctl.engine.phases import TRANSITIONS, IllegalTransition, transition
from cellctl.errors import BadInput, Busy, DeviceFault, NotEnabled, NotFound
from cellctl.messages import AckRequest, Event, Phase, Progress, PromoteRequest, RunRequest, State
from cellctl.permission import enable
from tests import cells
from tests.core.toy import ToyRobot, bench

PHASES = ("idle", "running", "waiting", "stopping", "fault")
EVENTS = ("start", "ask", "answer", "withdraw", "stop", "end", "fault", "ack")


@pytest.fixture
async def toy(tmp_path):
    async with bench(tmp_path) as toy:
        yield toy


# -- a run from start to end


async def test_a_run_is_done_recorded_and_told(toy):
    run_id = await toy.start("survey", views=3)
    assert toy.engine.state().phase == "running"
    assert toy.engine.state().active_run == run_id
    info = await toy.ended(run_id)
    assert (info.status, info.verdict, info.samples) == ("done", "pass", 3)
    assert info.params == {"views": 3, "scale": 1.0}
    assert info.progress is not None
    assert (info.progress.step, info.progress.done, info.progress.total) == ("collect", 3, 3)
    assert info.result is not None
    assert info.result["data"]["views"] == 3
    result = json.loads((toy.directory / "runs" / run_id / "result.json").read_text())
    assert result == {"schema": "cellctl-result/1", **info.result}
    told = ["started", "step", "sample", "sample", "sample", "ended"]
    assert toy.events() == told
    journalled = ["journal", *told[:-1], "result", "done"]
    assert [entry.kind for entry in toy.journal(run_id)] == journalled
    assert toy.robot.stops == []


async def test_run_json_says_what_the_run_was_made_with(toy):
    run_id = await toy.start("survey", views=1)
    await toy.ended(run_id)
    header = json.loads((toy.directory / "runs" / run_id / "run.json").read_text())
    assert header["schema"] == "cellctl-run/1"
    assert header["devices"]["robot"] == {
        "driver": "toy",
        "model": "bench arm",
        "serial": "R-1",
        "version": "",
    }
    assert header["config"]["robot"]["arm"] == "ur5"
    assert len(header["config_sha256"]) == 64
    assert {"python", "numpy", "cellctl"} <= set(header["versions"])
    assert (header["client"], header["request_id"], header["cell"]) == ("test", "request-1", "test")


async def test_watchers_see_phases_and_progress_in_order(toy):
    await toy.ended(await toy.start("survey", views=2))
    phases = [message.phase for message in toy.seen if isinstance(message, State)]
    assert phases == ["running", "stopping", "idle"]
    done = [message.done for message in toy.seen if isinstance(message, Progress)]
    assert done == [0, 1, 2]
    numbers = [message.seq for message in toy.seen if isinstance(message, Event)]
    assert numbers == list(range(1, len(numbers) + 1))


async def test_a_result_becomes_a_calibration_but_not_the_active_one(toy):
    info = await toy.ended(await toy.start("survey"))
    assert info.calibration_id == f"cal-{info.run_id}"
    calibration = await toy.engine.calibration(info.calibration_id)
    assert not calibration.active
    assert calibration.document["verdict"] == "pass"
    assert calibration.document["provenance"]["run_id"] == info.run_id
    assert info.result is not None
    assert calibration.document["calibration"]["slope"] == info.result["data"]["line"][0]
    assert toy.engine.state().active_calibration is None


async def test_promotion(toy):
    good = (await toy.ended(await toy.start("survey"))).calibration_id
    bad = await toy.ended(await toy.start("survey", "request-2", scale=-1.0))
    assert (bad.status, bad.verdict, bad.reasons) == ("done", "fail", ["the scale is not positive"])
    await toy.engine.promote(PromoteRequest(calibration_id=good))
    with pytest.raises(BadInput, match="failed its verdict"):
        await toy.engine.promote(PromoteRequest(calibration_id=bad.calibration_id))
    assert toy.engine.state().active_calibration == good
    forced = PromoteRequest(calibration_id=bad.calibration_id, despite_failed_verdict=True)
    await toy.engine.promote(forced)
    assert (await toy.engine.calibration("active")).calibration_id == bad.calibration_id
    assert toy.events().count("promoted") == 2
    with pytest.raises(NotFound, match="there are: cal-"):
        await toy.engine.promote(PromoteRequest(calibration_id="cal-x"))


async def test_a_policy_may_promote_what_passed(tmp_path):
    async with bench(tmp_path, promotes=lambda new, active: new["verdict"] == "pass") as toy:
        good = await toy.ended(await toy.start("survey"))
        await toy.until(lambda: toy.engine.state().active_calibration == good.calibration_id)
        await toy.ended(await toy.start("survey", "request-2", scale=-1.0))
        assert toy.engine.state().active_calibration == good.calibration_id


async def test_a_policy_that_is_refused_harms_nothing(tmp_path):
    async with bench(tmp_path, promotes=lambda new, active: True) as toy:
        await toy.ended(await toy.start("survey", scale=-1.0))
        assert toy.engine.state().active_calibration is None
        await toy.ended(await toy.start("survey", "request-2"))


async def test_a_procedure_is_given_the_calibration_that_was_active_at_its_start(toy):
    first = await toy.ended(await toy.start("look-up"))
    assert first.result is not None
    assert first.result["data"]["calibration"] is None
    surveyed = await toy.ended(await toy.start("survey", "request-2"))
    await toy.engine.promote(PromoteRequest(calibration_id=surveyed.calibration_id))
    second = await toy.ended(await toy.start("look-up", "request-3"))
    assert second.result is not None
    assert set(second.result["data"]["calibration"]) == {"slope", "offset"}


async def test_scopes_keep_chained_procedures_apart(toy):
    info = await toy.ended(await toy.start("chained", views=2))
    assert (info.status, info.samples) == ("done", 4)
    samples = [e for e in toy.journal(info.run_id) if e.kind == "sample"]
    assert [(sample.at, sample.data["key"]) for sample in samples] == [
        ("first/collect", "view-000"),
        ("first/collect", "view-001"),
        ("second/collect", "view-000"),
        ("second/collect", "view-001"),
    ]
    means = {sample.data["data"]["point"][1] for sample in samples}
    assert len(means) == 4, "each sample has noise of its own"


async def test_the_same_run_elsewhere_takes_the_same_samples(toy):
    first = await toy.ended(await toy.start("survey"))
    second = await toy.ended(await toy.start("survey", "request-2"))
    assert first.run_id != second.run_id
    assert first.result is not None
    assert second.result is not None
    assert first.result["data"] == second.result["data"]


# -- what is refused


@pytest.mark.parametrize(
    ("procedure", "params", "error", "words"),
    [
        ("surveys", {}, NotFound, "no procedure 'surveys'; there are: survey, chained"),
        ("survey", {"view": 3}, BadInput, "survey: unknown parameter 'view'; did you mean 'views'"),
        ("survey", {"colour": 3}, BadInput, "unknown parameter 'colour'; known here: scale, views"),
        ("survey", {"views": "many"}, BadInput, "survey: views: Input should be a valid integer"),
        ("survey", {"views": 0, "scale": []}, BadInput, "views: .*greater than or equal.*; scale"),
        ("troubled", {}, BadInput, "missing parameter 'kind'"),
        (
            "nested",
            {"survey": {"veiws": 3}},
            BadInput,
            "nested: unknown parameter 'survey.veiws'; did you mean 'views'",
        ),
    ],
)
async def test_bad_requests_are_named(toy, procedure, params, error, words):
    with pytest.raises(error, match=words):
        await toy.start(procedure, **params)
    assert (await toy.engine.runs()).runs == []
    assert toy.engine.state().phase == "idle"


async def test_one_run_at_a_time(toy):
    run_id = await toy.start("troubled", kind="wait")
    with pytest.raises(Busy, match=f"run {run_id} of troubled owns the cell") as caught:
        await toy.start("survey", "request-2")
    assert caught.value.details["active_run"] == run_id
    await toy.cancel()
    await toy.phase("idle")
    await toy.ended(await toy.start("survey", "request-2"))


async def test_of_two_triggers_at_once_one_is_told_busy(toy):
    outcomes = await asyncio.gather(
        toy.start("survey", "request-1"), toy.start("survey", "request-2"), return_exceptions=True
    )
    assert [type(outcome) for outcome in outcomes] == [str, Busy]
    await toy.ended(str(outcomes[0]))


async def test_motion_needs_permission_and_looking_does_not(tmp_path):
    async with bench(tmp_path, enabled=False) as toy:
        assert not toy.engine.state().enabled
        with pytest.raises(NotEnabled, match="cellctl enable"):
            await toy.start("survey")
        await toy.ended(await toy.start("look-up", "request-2"))
        grant = enable(tmp_path, 3600)
        state = toy.engine.state()
        assert (state.enabled, state.enabled_until) == (True, grant.until)
        await toy.ended(await toy.start("survey"))


async def test_a_cell_whose_config_enables_it_is_always_enabled(toy):
    state = toy.engine.state()
    assert (state.enabled, state.enabled_until, state.simulated) == (True, None, True)


async def test_a_device_that_is_silent_at_the_start_starts_nothing(tmp_path):
    robot = ToyRobot()
    robot.link_lost = True
    async with bench(tmp_path, robot=robot) as toy:
        with pytest.raises(DeviceFault, match=r"the robot did not say who it is within 0\.3 s"):
            await toy.start("survey")
        assert (await toy.engine.runs()).runs == []
        robot.link_lost = False
        await toy.ended(await toy.start("survey"))


# -- triggers are idempotent


async def test_the_same_request_gives_the_same_run_also_while_it_runs_and_after_a_restart(tmp_path):
    request = RunRequest(request_id="request-1", params={"kind": "wait"})
    async with bench(tmp_path) as toy:
        first = await toy.engine.start("troubled", request)
        second = await toy.engine.start("troubled", request)
        assert (first.replayed, second.replayed) == (False, True)
        assert first.run_id == second.run_id
    async with bench(tmp_path) as toy:
        third = await toy.engine.start("troubled", request)
        assert (third.run_id, third.replayed) == (first.run_id, True)
        assert third.boot != first.boot
        assert toy.engine.state().phase == "idle"
        assert len((await toy.engine.runs()).runs) == 1


async def test_a_request_id_is_not_used_for_something_else(toy):
    run_id = await toy.start("survey", views=2)
    await toy.ended(run_id)
    assert await toy.start("survey", views=2, scale=1.0) == run_id
    with pytest.raises(BadInput, match=f"'request-1' started run {run_id} of survey") as caught:
        await toy.start("survey", views=3)
    assert caught.value.details["run_id"] == run_id
    with pytest.raises(BadInput, match="use a new one"):
        await toy.start("chained", views=2)


# -- cancelling


async def test_cancel_stops_the_arm_and_ends_the_run(toy):
    run_id = await toy.start("survey", views=1000)
    await toy.until(lambda: toy.robot.moving)
    assert (await toy.cancel()).run_id == run_id
    info = await toy.ended(run_id)
    assert (info.status, info.error) == ("cancelled", "cancelled by test")
    assert not toy.robot.moving
    assert toy.robot.stops == [True]
    assert toy.engine.state().fault is None
    assert toy.journal(run_id)[-1].kind == "cancelled"


async def test_cancelling_twice_or_late_does_no_harm(toy):
    run_id = await toy.start("survey", views=1000)
    answers = await asyncio.gather(toy.cancel(), toy.cancel(run_id), toy.cancel())
    assert [answer.message for answer in answers] == [
        "the run is being cancelled",
        "the run is ending already",
        "the run is ending already",
    ]
    await toy.ended(run_id)
    assert (await toy.cancel(run_id)).message == "the run is cancelled already"
    with pytest.raises(NotFound, match="nothing is running"):
        await toy.cancel()
    with pytest.raises(NotFound, match="no run 'run-x'"):
        await toy.cancel("run-x")
    assert [e.kind for e in toy.journal(run_id)].count("cancelled") == 1


@pytest.mark.parametrize("kind", ["wait", "busy"])
async def test_cancel_reaches_a_procedure_at_once_and_at_its_checkpoints(toy, kind):
    run_id = await toy.start("troubled", kind=kind)
    await toy.until(lambda: "step" in toy.events())
    with structlog.testing.capture_logs() as logs:
        await toy.cancel()
        assert (await toy.ended(run_id)).status == "cancelled"
    assert toy.robot.stops == [True]
    assert toy.engine.state().phase == "idle"
    assert [line["event"] for line in logs if line["log_level"] == "error"] == []


async def test_cancel_before_the_procedure_began(toy):
    run_id = await toy.start("survey")
    await toy.cancel()
    assert (await toy.ended(run_id)).status == "cancelled"
    assert toy.robot.moves == 0


async def test_what_is_done_cannot_be_cancelled(toy):
    run_id = await toy.start("survey", views=1)
    await toy.ended(run_id)
    with pytest.raises(BadInput, match="is done; there is nothing to cancel"):
        await toy.cancel(run_id)


async def test_cancel_in_the_middle_of_the_maths(toy):
    run_id = await toy.start("survey", views=1)
    await toy.until(lambda: "sample" in toy.events())
    assert (await toy.cancel()).message == "the run is being cancelled"
    assert (await toy.ended(run_id)).status == "cancelled"
    await toy.ended(await toy.start("survey", "request-2", views=1))


# -- how runs fail


@pytest.mark.parametrize(
    ("kind", "status", "words", "fault"),
    [
        ("bad input", "failed", "^the board is upside down$", None),
        ("fault", "interrupted", "the camera was unplugged", "the camera was unplugged"),
        ("not enabled", "interrupted", "the permission to move ended", None),
        ("group", "interrupted", "the projector went dark", "the projector went dark"),
        ("child death", "interrupted", "exited with code 4", "exited with code 4"),
        ("child defect", "failed", "divide_by_zero failed: ZeroDivisionError", None),
        ("defect", "failed", "a defect of the program: ValueError: invalid literal", None),
        ("not finite", "failed", "cannot be written as JSON", None),
        ("not json", "failed", "a defect of the program: TypeError: object", None),
        ("twice", "failed", "collect/one: this sample was taken already", None),
        ("cancels itself", "failed", "a defect of the program: .*CancelledError", None),
    ],
)
async def test_a_failing_procedure_is_classified(toy, kind, status, words, fault):
    info = await toy.ended(run_id := await toy.start("troubled", kind=kind))
    assert info.status == status
    with pytest.raises(AssertionError, match=words):
        raise AssertionError(info.error)
    state = toy.engine.state()
    assert state.phase == ("fault" if fault else "idle")
    assert (fault or "") in (state.fault or "")
    assert toy.robot.stops == [fault is None], "the arm is stopped, and hard after a device fault"
    end = toy.journal(run_id)[-1]
    assert end.kind == status
    assert ("traceback" in end.data) == (status == "failed")


async def test_a_traceback_of_a_defect_is_in_the_journal(toy):
    info = await toy.ended(await toy.start("troubled", kind="defect"))
    assert 'int("seven")' in toy.journal(info.run_id)[-1].data["traceback"]
    info = await toy.ended(await toy.start("troubled", "request-2", kind="child defect"))
    assert "return 1 / 0" in toy.journal(info.run_id)[-1].data["traceback"]


async def test_a_procedure_has_to_return_a_result(toy):
    info = await toy.ended(await toy.start("no-result"))
    assert "no-result returned dict, no Result" in str(info.error)


async def test_a_fault_is_sticky_until_a_person_acknowledges_it(toy):
    run_id = await toy.start("troubled", kind="fault")
    await toy.phase("fault")
    with pytest.raises(DeviceFault, match=r"the camera was unplugged.*`cellctl ack`"):
        await toy.start("survey", "request-2")
    with pytest.raises(DeviceFault, match="the camera was unplugged"):
        await toy.resume(run_id)
    await toy.ack()
    assert toy.engine.state().fault is None
    await toy.ended(await toy.start("survey", "request-2"))
    with pytest.raises(BadInput, match="there is nothing to acknowledge"):
        await toy.ack()


async def test_a_fault_survives_a_restart(tmp_path):
    async with bench(tmp_path) as toy:
        run_id = await toy.start("troubled", kind="fault")
        await toy.phase("fault")
    async with bench(tmp_path) as toy:
        assert toy.engine.state().phase == "fault"
        assert toy.engine.state().fault == "the camera was unplugged"
        with pytest.raises(DeviceFault):
            await toy.start("survey", "request-2")
        await toy.ack()
        assert toy.journal(run_id)[-1].kind == "acknowledged"
    async with bench(tmp_path) as toy:
        assert toy.engine.state().phase == "idle"
        assert (await toy.engine.run_info(run_id)).status == "interrupted"


async def test_abandoning_a_run_does_not_acknowledge_its_fault(tmp_path):
    async with bench(tmp_path) as toy:
        run_id = await toy.start("troubled", kind="fault")
        await toy.phase("fault")
        await toy.cancel(run_id)
        assert toy.engine.state().phase == "fault"
    async with bench(tmp_path) as toy:
        assert toy.engine.state().fault == "the camera was unplugged"


@pytest.mark.parametrize("how", ["stop_fails", "stop_hangs"])
async def test_an_arm_that_cannot_be_stopped_is_a_fault_for_a_person(toy, how):
    run_id = await toy.start("survey", views=1000)
    await toy.until(lambda: toy.robot.moving)
    setattr(toy.robot, how, True)
    await toy.cancel()
    info = await toy.ended(run_id)
    assert info.status == "cancelled"
    state = toy.engine.state()
    assert state.phase == "fault"
    assert "the arm could not be stopped" in str(state.fault)
    assert "press the emergency stop" in str(state.fault)
    setattr(toy.robot, how, False)
    await toy.ack()
    await toy.ended(await toy.start("survey", "request-2", views=1))


async def test_a_fault_while_unwinding_is_not_lost(toy):
    run_id = await toy.start("troubled", kind="late fault")
    await toy.until(lambda: "step" in toy.events())
    await toy.cancel()
    info = await toy.ended(run_id)
    assert info.status == "cancelled"
    assert toy.engine.state().fault == "the arm did not stop when it was told to"


async def test_a_procedure_that_does_not_end_is_a_fault_that_cannot_be_acknowledged(toy):
    run_id = await toy.start("troubled", kind="stubborn", seconds=1.5)
    await toy.until(lambda: "step" in toy.events())
    await toy.cancel()
    info = await toy.ended(run_id)
    assert info.status == "cancelled"
    assert "does not end when it is told to: restart the daemon" in str(toy.engine.state().fault)
    assert False in toy.robot.stops
    with pytest.raises(DeviceFault, match="cannot be acknowledged before that"):
        await toy.ack()
    await asyncio.sleep(1.5)  # it has ended by itself now
    await toy.ack()


async def test_a_subscriber_that_raises_does_not_disturb_the_run(toy):
    def broken(_):
        raise ValueError("a subscriber's defect")

    unsubscribe = toy.engine.subscribe(broken)
    assert (await toy.ended(await toy.start("survey", views=1))).status == "done"
    unsubscribe()
    unsubscribe()


def test_events_are_bounded_and_numbered():
    bulletin = Bulletin("boot-1")
    for number in range(KEPT + 20):
        bulletin.event("sample", "run-1", number=number)
    events = bulletin.since(0).events
    assert [events[0].seq, events[-1].seq] == [21, KEPT + 20]
    assert [e.data["number"] for e in bulletin.since(KEPT + 18).events] == [KEPT + 18, KEPT + 19]


# -- questions


async def test_a_question_waits_for_one_of_its_answers(toy):
    run_id = await toy.start("asking")
    state = await toy.phase("waiting")
    assert state.question is not None
    assert (state.question.text, state.question.choices) == ("Which colour?", ["red", "blue"])
    assert (await toy.engine.run_info(run_id)).status == "waiting"
    with pytest.raises(BadInput, match=r"'green' is not an answer to 'Which colour.'.*red, blue"):
        await toy.ack("green")
    await toy.ack("blue")
    await toy.phase("waiting")
    await toy.ack("yes")
    info = await toy.ended(run_id)
    assert info.result is not None
    assert info.result["data"] == {"colour": "blue", "sure": "yes"}
    answers = [e.data["answer"] for e in toy.journal(run_id) if e.kind == "answer"]
    assert answers == ["blue", "yes"]


async def test_a_late_answer_is_not_taken_for_another_questions(toy):
    run_id = await toy.start("asking")
    first = (await toy.phase("waiting")).question
    assert first is not None
    await toy.ack("red", first.id)
    with pytest.raises(BadInput, match=r"no longer asked|answered already"):
        await toy.ack("red", first.id)
    await toy.phase("waiting")
    with pytest.raises(BadInput, match=f"question {first.id} is no longer asked; now it is"):
        await toy.ack("yes", first.id)
    await toy.cancel()
    await toy.ended(run_id)
    with pytest.raises(BadInput, match="is no longer asked"):
        await toy.ack("yes", first.id)


async def test_where_there_is_a_choice_the_question_is_named(toy):
    run_id = await toy.start("asking")
    question = (await toy.phase("waiting")).question
    assert question is not None
    command = f"cellctl ack --answer red --question {question.id}"
    with pytest.raises(BadInput, match=f"say which question is answered.*{command}"):
        await toy.engine.ack(AckRequest(answer="red"))
    await toy.cancel()
    assert (await toy.ended(run_id)).status == "cancelled"


async def test_cancel_while_waiting(toy):
    run_id = await toy.start("asking")
    await toy.phase("waiting")
    with structlog.testing.capture_logs() as logs:
        await toy.cancel()
        state = toy.engine.state()
        assert (state.phase, state.question) == ("stopping", None)
        with pytest.raises(BadInput, match="nothing to acknowledge"):
            await toy.ack("red")
        assert (await toy.ended(run_id)).status == "cancelled"
    assert [line["event"] for line in logs if line["log_level"] == "error"] == []


async def test_a_question_with_a_deadline_is_withdrawn(toy):
    info = await toy.ended(await toy.start("impatient", views=1))
    assert info.status == "done"
    kinds = [entry.kind for entry in toy.journal(info.run_id)]
    assert kinds[2:5] == ["question", "withdrawn", "record"]
    assert "waiting" in [m.phase for m in toy.seen if isinstance(m, State)]


async def test_step_asks_before_every_motion_until_told_otherwise(toy):
    request = RunRequest(request_id="request-1", params={"views": 4}, step=True)
    run_id = (await toy.engine.start("survey", request)).run_id
    for answer in ("go", "go on without asking"):
        state = await toy.phase("waiting")
        assert state.question is not None
        assert state.question.text.startswith("Next: view")
        await toy.ack(answer)
        await toy.phase("running", "idle")
    assert (await toy.ended(run_id)).status == "done"
    assert toy.events().count("question") == 2


async def test_step_can_cancel(toy):
    request = RunRequest(request_id="request-1", params={"views": 4}, step=True)
    run_id = (await toy.engine.start("survey", request)).run_id
    await toy.phase("waiting")
    await toy.ack("cancel")
    info = await toy.ended(run_id)
    assert (info.status, info.error) == ("cancelled", "the operator cancelled it at a checkpoint")
    assert toy.robot.moves == 0


async def test_speed_reaches_the_procedure(toy):
    request = RunRequest(request_id="request-1", params={"views": 2}, speed=1.0)
    await toy.engine.start("survey", request)
    await toy.until(lambda: toy.robot.moves == 2)
    await asyncio.sleep(0.05)
    assert toy.robot.moving, "at one percent it takes 0.5 s"
    await toy.cancel()
    await toy.phase("idle")


# -- ending and going on


async def interrupted(directory, **params):
    """A run that a shutdown cut short after a few samples."""
    async with bench(directory) as toy:
        run_id = await toy.start("survey", views=8, **params)
        await toy.until(lambda: toy.events().count("sample") >= 3)
        await toy.engine.shutdown()
        assert toy.robot.stops == [True]
        info = await toy.engine.run_info(run_id)
        assert (info.status, info.error) == ("interrupted", "the daemon was stopped")
        with pytest.raises(Busy, match="shutting down"):
            await toy.start("survey", "request-2")
    return run_id


async def test_an_interrupted_run_goes_on_to_the_same_result(tmp_path):
    run_id = await interrupted(tmp_path / "a")
    async with bench(tmp_path / "a") as toy:
        assert toy.robot.moves == 0, "nothing moves on start-up"
        before = sum(e.kind == "sample" for e in toy.journal(run_id))
        assert not (await toy.resume(run_id)).replayed
        assert (await toy.resume(run_id)).replayed
        resumed = await toy.ended(run_id)
        assert toy.robot.moves == 8 - before
    async with bench(tmp_path / "b") as toy:
        whole = await toy.ended(await toy.start("survey", views=8))
    assert resumed.status == "done"
    assert resumed.result is not None
    assert whole.result is not None
    assert resumed.result["data"] == whole.result["data"]
    assert resumed.samples == whole.samples == 8


async def test_a_waiting_run_asks_again_after_a_restart(tmp_path):
    async with bench(tmp_path) as toy:
        run_id = await toy.start("asking")
        await toy.phase("waiting")
    async with bench(tmp_path) as toy:
        assert toy.engine.state().question is None
        await toy.resume(run_id)
        state = await toy.phase("waiting")
        assert state.question is not None
        assert state.question.text == "Which colour?"
        await toy.ack("red")
        await toy.phase("waiting")
        await toy.ack("yes")
        assert (await toy.ended(run_id)).status == "done"


async def test_only_an_interrupted_run_can_be_resumed(toy):
    run_id = await toy.start("survey", views=1)
    await toy.ended(run_id)
    with pytest.raises(BadInput, match="is done; only an interrupted run can be resumed"):
        await toy.resume(run_id)
    with pytest.raises(NotFound, match=f"no run 'run-x'; the newest are: {run_id}"):
        await toy.resume("run-x")


async def test_an_interrupted_run_can_be_abandoned(tmp_path):
    run_id = await interrupted(tmp_path)
    async with bench(tmp_path) as toy:
        assert (await toy.cancel(run_id)).message == "the run is abandoned"
        assert (await toy.cancel(run_id)).message == "the run is abandoned already"
        with pytest.raises(BadInput, match="is abandoned; only an interrupted"):
            await toy.resume(run_id)
        assert (await toy.engine.run_info(run_id)).status == "abandoned"


async def test_a_run_is_not_resumed_on_another_cell(tmp_path):
    run_id = await interrupted(tmp_path)
    moved = cells.document()
    moved["camera"]["pose"]["position_m"] = [0.0, -0.44, 0.81]
    async with bench(tmp_path, document=moved) as toy:
        with pytest.raises(BadInput, match=r"recorded with another camera \(config\)"):
            await toy.resume(run_id)
    other = ToyRobot()
    other.serial = "R-2"
    async with bench(tmp_path, robot=other) as toy:
        with pytest.raises(BadInput, match=r"recorded with another robot \(device\)"):
            await toy.resume(run_id)
    elsewhere = cells.document()
    elsewhere["bus"] = {"listen": "tcp/127.0.0.1:7777"}
    async with bench(tmp_path, document=elsewhere) as toy:
        await toy.resume(run_id)
        assert (await toy.ended(run_id)).status == "done"


async def test_a_run_is_not_resumed_without_permission(tmp_path):
    run_id = await interrupted(tmp_path)
    async with bench(tmp_path, enabled=False) as toy:
        with pytest.raises(NotEnabled):
            await toy.resume(run_id)
        assert (await toy.engine.run_info(run_id)).status == "interrupted"


async def test_a_result_that_was_journalled_is_finished_without_moving(tmp_path):
    """As after a kill between the result's line and the run's last one."""
    async with bench(tmp_path) as toy:
        whole = await toy.ended(await toy.start("survey"))
    directory = tmp_path / "runs" / whole.run_id
    lines = (directory / "journal.jsonl").read_bytes().splitlines(keepends=True)
    (directory / "journal.jsonl").write_bytes(b"".join(lines[:-1]))
    (directory / "result.json").unlink()
    async with bench(tmp_path) as toy:
        assert (await toy.engine.run_info(whole.run_id)).status == "interrupted"
        await toy.resume(whole.run_id)
        again = await toy.ended(whole.run_id)
        assert toy.events() == ["resumed", "ended"], "the procedure is not run again"
    assert again.status == "done"
    assert again.result == whole.result


async def test_shutdown_while_idle_and_twice(toy):
    await toy.engine.shutdown()
    await toy.engine.shutdown()
    assert toy.robot.stops == []


async def test_a_damaged_run_can_neither_be_resumed_nor_stop_the_daemon(tmp_path):
    run_id = await interrupted(tmp_path)
    journal = tmp_path / "runs" / run_id / "journal.jsonl"
    journal.write_bytes(journal.read_bytes().replace(b"view-001", b"view-007"))
    async with bench(tmp_path) as toy:
        with pytest.raises(BadInput, match="is failed"):
            await toy.resume(run_id)
        info = await toy.engine.run_info(run_id)
        assert "is damaged: its checksum does not match" in str(info.error)


async def test_procedures_show_their_parameters(toy):
    shown = {item.name: item for item in toy.engine.procedures().procedures}
    assert shown["survey"].moves
    assert shown["survey"].params["properties"]["views"]["default"] == 5
    assert not shown["look-up"].moves


async def test_a_run_ends_though_there_is_no_snapshot_to_tell(toy, monkeypatch):
    """As when the disk that holds the permission fails in the middle of a run."""

    def broken():
        raise OSError(5, "Input/output error")

    run_id = await toy.start("survey", views=1000)
    await toy.until(lambda: toy.robot.moving)
    monkeypatch.setattr(toy.engine, "state", broken)
    with structlog.testing.capture_logs() as logs:
        await toy.cancel()
        await toy.until(lambda: "ended" in toy.events())
    monkeypatch.undo()
    assert {line["event"] for line in logs if line["log_level"] == "error"} == {
        "there is no snapshot of the state"
    }
    assert (await toy.engine.run_info(run_id)).status == "cancelled"
    assert toy.engine.state().phase == "idle"
    assert toy.robot.stops == [True]


STRANGE = os.fsdecode(b"caf\xe9")
"""The name of a file in Latin-1, as Python has it where names are UTF-8."""


async def test_names_that_are_not_utf8_are_recorded_and_told(tmp_path):
    async with bench(tmp_path / STRANGE) as toy:
        info = await toy.ended(await toy.start("survey", views=1))
        assert info.status == "done"
        assert json.loads(info.model_dump_json())["directory"].endswith(f"runs/{info.run_id}")
        shown = str(toy.directory).replace("\udce9", r"\udce9")
        assert info.directory == f"{shown}/runs/{info.run_id}"


@pytest.mark.parametrize("kind", ["strange fault", "strange defect"])
async def test_an_error_about_such_a_name_ends_a_run_as_any_other(toy, kind):
    with structlog.testing.capture_logs() as logs:
        info = await toy.ended(await toy.start("troubled", kind=kind))
    assert "the supervision of a run failed" not in [line["event"] for line in logs]
    assert r"caf\udce9" in str(info.error)
    assert toy.journal(info.run_id)[-1].kind == info.status
    for message in (info, toy.engine.events()):
        assert r"caf\\udce9" in message.model_dump_json()
    assert toy.engine.state().model_dump_json()


# -- the table


LEGAL = {
    "idle": {"start": "running"},
    "running": {"ask": "waiting", "stop": "stopping"},
    "waiting": {"answer": "running", "withdraw": "running", "stop": "stopping"},
    "stopping": {"end": "idle", "fault": "fault"},
    "fault": {"ack": "idle"},
}


@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize("event", EVENTS)
def test_the_table_is_all_there_is(phase, event):
    if event in LEGAL[phase]:
        assert transition(phase, event) == LEGAL[phase][event]
    else:
        with pytest.raises(IllegalTransition, match=f"'{event}' in phase '{phase}'"):
            transition(phase, event)


def test_every_phase_is_reached_and_left():
    assert {phase for phase, _ in TRANSITIONS} == set(PHASES) == set(TRANSITIONS.values())
    reachable: set[Phase] = set()
    frontier: set[Phase] = {"idle"}
    while frontier:
        reachable |= frontier
        frontier = {to for (phase, _), to in TRANSITIONS.items() if phase in frontier} - reachable
    assert reachable == set(PHASES)
