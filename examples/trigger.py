"""Trigger a calibration over Zenoh and print what came of it, without cellctl.

python trigger.py [ENDPOINT CELL PROCEDURE]       needs: pip install eclipse-zenoh
"""

import json
import sys
import uuid

import zenoh

endpoint, cell, procedure = sys.argv[1:] or ("tcp/127.0.0.1:7450", "sim-cr", "full")
root = f"cell/{cell}/@v1"

config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("scouting/multicast/enabled", "false")
config.insert_json5("connect/endpoints", json.dumps([endpoint]))


def ask(session: zenoh.Session, path: str, body: object = None) -> dict:
    for reply in session.get(f"{root}/{path}", payload=json.dumps(body or {}), timeout=10):
        if reply.ok:
            return json.loads(reply.ok.payload.to_bytes())
        sys.exit(f"{path}: {reply.err.payload.to_string()}")
    sys.exit(f"{path}: nobody answers at {endpoint}")


with zenoh.open(config) as session, session.declare_subscriber(f"{root}/event") as events:
    request = {"request_id": uuid.uuid4().hex, "client": "trigger.py"}
    run_id = ask(session, f"cmd/run/{procedure}", request)["run_id"]
    for sample in events:
        event = json.loads(sample.payload.to_bytes())
        print(event["kind"], event["data"])
        if (event["run_id"], event["kind"]) == (run_id, "ended"):
            break
    info = ask(session, f"get/run/{run_id}")
    print(info["status"], info["verdict"], json.dumps(info["result"], indent=2))
