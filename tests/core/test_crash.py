"""The daemon is killed at random instants: nothing that was recorded is lost or taken twice, and
the result is the uninterrupted one's, to the last digit. CELLCTL_SOAK sets the number of kills."""

from __future__ import annotations

import json
import os
import random
import signal
import threading
import time
from pathlib import Path

import pytest

from cellctl.store.history import History
from cellctl.store.journal import read
from tests.core.processes import alive, python

KILLS = int(os.environ.get("CELLCTL_SOAK", "12"))
VIEWS = 10
SEED = 7


class Lives:
    """Lives of a daemon on one data directory."""

    def __init__(self, process, directory):
        self._process = process
        self._directory = directory
        self.samples: set[str] = set()

    def live(self, request_id, kill=None):
        """One life. `kill`: after how many things that it said, and how much later, it is killed.
        Returns what the run ended with, if it did."""
        self._process.stdin.write(f"{self._directory} {request_id} {VIEWS}\n")
        self._process.stdin.flush()
        outcome, timer = None, None
        for heard, line in enumerate(self._process.stdout):
            word, _, rest = line.strip().partition(" ")
            if word == "born":
                pid = int(rest)
            elif word == "sample":
                assert rest not in self.samples, f"{rest} was taken twice"
                self.samples.add(rest)
            elif word == "ended":
                outcome = json.loads(rest)
            elif word == "dead":
                break
            if kill is not None and timer is None and heard == kill[0]:
                timer = threading.Timer(kill[1], os.kill, (pid, signal.SIGKILL))
                timer.start()
        if timer is not None:
            timer.cancel()
            timer.join()
        return outcome


def instant(chance: random.Random) -> tuple[int, float]:
    """Any moment of a life: from its birth, between samples, to the writing of its result."""
    said = chance.choice([0, 1, *range(2, 2 + VIEWS), 1 + VIEWS])
    return said, chance.uniform(0, 0.3 if said in (0, 1 + VIEWS) else 0.05)


def journalled(directory: Path) -> list[str]:
    """The keys of all samples in the newest run's journal, which must not be damaged and must not
    name a picture that is not there."""
    runs = sorted((directory / "runs").glob("2*"))
    entries = read(runs[-1] / "journal.jsonl").intact() if runs else []
    for samples in History(runs[-1], entries).steps().values() if runs else ():
        for sample in samples.values():
            assert sample.images["camera"].load().shape == (24, 32)
    return [entry.data["key"] for entry in entries if entry.kind == "sample"]


@pytest.fixture
def lives(tmp_path):
    with python("-m", "tests.core.lives") as process:
        yield Lives(process, tmp_path)


def test_killed_at_random_instants_nothing_is_lost(lives, tmp_path):
    _, reference = lives.live("reference-run")
    chance, kills, runs = random.Random(SEED), 0, 0
    while kills < KILLS:
        runs, lives.samples, outcome = runs + 1, set(), None
        while outcome is None:
            kill = instant(chance) if kills < KILLS else None
            outcome = lives.live(f"request-{runs}", kill)
            kills += outcome is None
            keys = journalled(tmp_path)
            assert len(keys) == len(set(keys)), "a sample was recorded twice"
            assert lives.samples <= set(keys), "a sample that was told to be safe is lost"
        assert outcome == ["done", reference]


def test_the_solver_does_not_outlive_a_killed_daemon(lives):
    children = Path(f"/proc/{lives._process.pid}/task/{lives._process.pid}/children")
    seen: set[int] = set()

    def watch():
        while not seen or all(alive(pid) for pid in seen):
            for life in children.read_text().split():
                for task in Path(f"/proc/{life}/task").glob("*/children"):
                    seen.update(int(pid) for pid in task.read_text().split())
            if seen:
                os.kill(int(life), signal.SIGKILL)
                return
            time.sleep(0.005)

    watcher = threading.Thread(target=watch)
    watcher.start()
    lives.live("request-1")
    watcher.join()
    deadline = time.monotonic() + 5
    while any(alive(pid) for pid in seen):
        assert time.monotonic() < deadline, "the solver outlived the daemon"
        time.sleep(0.01)
    assert seen


DISK_FULL = """
import asyncio, resource, sys
from pathlib import Path
import structlog
from tests.core.toy import bench

def limit(size):
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))

async def main():
    async with bench(Path(sys.argv[1])) as toy:
        run_id = await toy.start("survey", views=12)
        await toy.until(lambda: toy.events().count("sample") >= 4)
        limit((toy.directory / "runs" / run_id / "journal.jsonl").stat().st_size + 100)
        info = await toy.ended(run_id)
        print(toy.engine.state().phase, info.status, info.error, sep="|")
        limit(resource.RLIM_INFINITY)
        await toy.ack()
        await toy.resume(run_id)
        info = await toy.ended(run_id)
        print(info.status, info.samples, info.result["data"]["views"], sep="|")

structlog.configure(logger_factory=structlog.PrintLoggerFactory(sys.stderr))
asyncio.run(main())
"""


def test_a_full_disk_interrupts_the_run_which_can_be_resumed(tmp_path):
    with python("-c", DISK_FULL, str(tmp_path)) as process:
        full, resumed = process.communicate()[0].splitlines()
    assert full.startswith("fault|interrupted|cannot write ")
    assert "journal.jsonl" in full
    assert resumed == "done|12|12"
