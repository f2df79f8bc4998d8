"""Trigger a run over Zenoh, print what comes of it: `python trigger.py ENDPOINT CELL PROCEDURE`."""

import json
import sys
import time
from typing import Any

import zenoh

endpoint, cell, procedure = sys.argv[1:] or ("tcp/127.0.0.1:7450", "sim-cr", "full")
config = zenoh.Config.from_json5(
    f"{{mode: 'client', connect: {{endpoints: ['{endpoint}']}},"
    " scouting: {multicast: {enabled: false}}}"
)


def ask(session: zenoh.Session, path: str, **body: object) -> Any:
    for reply in session.get(f"cell/{cell}/@v1/{path}", payload=json.dumps(body), timeout=10):
        if reply.ok is None:
            sys.exit(f"{path}: {reply.err and reply.err.payload.to_string()}")
        return json.loads(reply.ok.payload.to_bytes())
    sys.exit(f"{path}: nobody answers at {endpoint}")


with zenoh.open(config) as session, session.declare_subscriber(f"cell/{cell}/@v1/event") as events:
    run = ask(session, f"cmd/run/{procedure}", request_id=f"trigger-{time.time_ns()}")["run_id"]
    while (info := ask(session, f"get/run/{run}"))["status"] in ("running", "waiting"):
        while (sample := events.try_recv()) is not None:
            print(sample.payload.to_string())
        time.sleep(0.5)
    print(json.dumps(info, indent=2))
