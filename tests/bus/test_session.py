from __future__ import annotations

import pytest
import zenoh

from cellctl.bus.keys import Keys, check_name, parse_live
from cellctl.bus.session import check_endpoint, open_connected, open_listening, plain
from cellctl.errors import BadInput, Unreachable


@pytest.mark.parametrize(
    "endpoint", ["tcp/127.0.0.1:7450", "tcp/127.9.9.9:1", "tcp/[::1]:65535", "tcp/localhost:80"]
)
def test_loopback_endpoints_are_taken(endpoint):
    check_endpoint(endpoint)


@pytest.mark.parametrize(
    ("endpoint", "reason"),
    [
        ("7450", "expected tcp/HOST:PORT"),
        ("tcp/127.0.0.1", "expected tcp/HOST:PORT"),
        ("udp/127.0.0.1:7450", "expected tcp/HOST:PORT"),
        ("tcp/127.0.0.1:7450#iface=eth0", "expected tcp/HOST:PORT"),
        ("tcp/127.0.0.1:0", "1 to 65535"),
        ("tcp/127.0.0.1:70000", "1 to 65535"),
        ("tcp/0.0.0.0:7450", "only loopback"),
        ("tcp/[::]:7450", "only loopback"),
        ("tcp/192.168.1.2:7450", "only loopback"),
        ("tcp/example.org:7450", "only loopback"),
    ],
)
@pytest.mark.parametrize("open_session", [open_listening, open_connected])
def test_other_endpoints_are_refused_with_the_reason(endpoint, reason, open_session):
    with pytest.raises(BadInput, match=reason) as caught:
        open_session(endpoint)
    assert repr(endpoint) in caught.value.message


def test_a_taken_port_is_named(endpoint):
    with (
        open_listening(endpoint),
        pytest.raises(BadInput, match="the port is in use") as caught,
    ):
        open_listening(endpoint)
    assert endpoint in caught.value.message
    assert ".rs" not in caught.value.message


def test_nobody_there_is_unreachable_and_says_what_to_check(endpoint):
    with pytest.raises(Unreachable, match="cellctl serve") as caught:
        open_connected(endpoint)
    assert endpoint in caught.value.message
    assert ".rs" not in caught.value.message


def test_sessions_do_not_announce_themselves(endpoint):
    with open_listening(endpoint) as one:
        assert one.info.links() == []
        with open_connected(endpoint) as other:
            assert [link.dst.split("?")[0] for link in other.info.links()] == [endpoint]


def test_plain_strips_every_source_place():
    error = zenoh.ZError(
        "bad [x: y (os error 98) at /a/b/tcp.rs:61.] at /a/b/c-1.2/unicast.rs:338."
    )
    assert plain(error) == "bad [x: y (os error 98).]"


@pytest.mark.parametrize("name", ["", "..", ".hidden", "a/b", "a*", "a?x", "ä", "x" * 129, "a b"])
def test_names_that_are_no_names(name):
    with pytest.raises(BadInput, match="run id"):
        check_name(name, "run id")


@pytest.mark.parametrize("cell", ["", "CR", "*", "a/b", "-a", "x" * 33])
def test_cell_ids_that_are_none(cell):
    with pytest.raises(BadInput, match="cell id"):
        Keys(cell)


def test_keys_of_a_cell():
    keys = Keys("sim-cr")
    assert keys.live("b1") == "cell/sim-cr/@v1/live/b1"
    assert parse_live(keys.live("b1")) == ("sim-cr", "b1")
    assert keys.progress("r.1") == "cell/sim-cr/@v1/run/r.1/progress"
    reading, commanding = (zenoh.KeyExpr(key) for key in keys.requests)
    assert reading.includes(keys.request("get/run/r1"))
    assert not reading.intersects(keys.request("cmd/run/full"))
    assert commanding.includes(keys.request("cmd/run/full"))
