"""Trigger a run over Zenoh, print what comes of it: `python trigger.py ENDPOINT CELL PROCEDURE`."""

import json
import sys
import uuid

import zenoh

endpoint, cell, procedure = sys.argv[1:] or ("tcp/127.0.0.1:7450", "sim-cr", "full")
config = zenoh.Config.from_json5(
    f"{{mode: 'client', connect: {{endpoints: ['{endpoint}']}},"
    " scouting: {multicast: {enabled: false}}}"
)


def ask(session: zenoh.Session, path: str, **body: object) -> dict:
    for reply in session.get(f"cell/{cell}/@v1/{path}", payload=json.dumps(body), timeout=10):
        if reply.ok:
            return json.loads(reply.ok.payload.to_bytes())
        sys.exit(f"{path}: {reply.err.payload.to_string()}")
    sys.exit(f"{path}: nobody answers at {endpoint}")


with zenoh.open(config) as session, session.declare_subscriber(f"cell/{cell}/@v1/event") as events:
    run = ask(session, f"cmd/run/{procedure}", request_id=uuid.uuid4().hex)["run_id"]
    for sample in events:
        event = json.loads(sample.payload.to_bytes())
        print(event["kind"], event["data"])
        if (event["run_id"], event["kind"]) == (run, "ended"):
            break
    print(json.dumps(ask(session, f"get/run/{run}"), indent=2))
