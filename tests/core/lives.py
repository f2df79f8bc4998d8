"""A daemon that is killed: each line on stdin starts a life of it, and tells what it did.

The modules are imported once and each life is forked, so that a kill costs no second of imports.
A life starts the run that the line names, or resumes it, and says each sample after the engine
said that it is recorded.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys
from pathlib import Path

import structlog

from cellctl.messages import Event, RunRequest
from tests.core.toy import bench


def say(*words: object) -> None:
    """One line in one write: a kill must not tear it."""
    os.write(1, (" ".join(map(str, words)) + "\n").encode())


def tell(message: object) -> None:
    if isinstance(message, Event) and message.kind == "sample":
        say("sample", message.data["key"])


async def life(directory: Path, request_id: str, views: int) -> None:
    async with bench(directory) as toy:
        toy.engine.subscribe(tell)
        request = RunRequest(request_id=request_id, params={"views": views})
        accepted = await toy.engine.start("survey", request)
        info = await toy.engine.run_info(accepted.run_id)
        if info.status == "interrupted":
            await toy.resume(accepted.run_id)
        say("going", accepted.run_id)
        info = await toy.ended(accepted.run_id)
        say("ended", json.dumps([info.status, info.result and info.result["data"]]))


def main() -> None:
    structlog.configure(logger_factory=structlog.PrintLoggerFactory(sys.stderr))
    for line in sys.stdin:
        directory, request_id, views = line.split()
        pid = os.fork()
        if pid == 0:
            asyncio.run(life(Path(directory), request_id, int(views)))
            os._exit(0)
        say("born", pid)
        os.waitpid(pid, 0)
        say("dead")


if __name__ == "__main__":
    main()
