"""Where a server listens; whom it answers is tried on the viewer itself (``tests/viewing/test_server.py``)."""

import socket

import pytest

from sparsestreet.listening import Callers, check_address, opened_at


def test_each_reason_why_nobody_can_listen_is_called_that():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        busy = taken.getsockname()[1]
        for host, port, said in (
            ("nosuchhost.invalid", 0, "the host 'nosuchhost.invalid' is unknown: host= is a name"),
            ("a..b", 0, "is unknown"),
            ("203.0.113.7", 8080, "nobody can listen on 203.0.113.7:8080: this machine has no such address"),
            ("[2001:db8::7]", 1, r"on \[2001:db8::7\]:1: this machine has no such address"),
            ("127.0.0.1", busy, f"nobody can listen on 127.0.0.1:{busy}: another server may, choose another port="),
        ):
            with pytest.raises(OSError, match=said):
                check_address(host, port)
    for host in ("127.0.0.1", "localhost", "0.0.0.0"):
        check_address(host, 0)


def test_the_address_that_is_printed_can_be_opened():
    assert opened_at("::1", 80) == opened_at("[::1]", 80) == "[::1]:80"
    assert opened_at("0.0.0.0", 80) == opened_at("", 80) == opened_at("::", 80) == f"{socket.gethostname()}:80"


def test_a_server_on_all_addresses_answers_to_the_name_of_the_machine_and_to_the_one_that_was_reached():
    callers, own = Callers.of("0.0.0.0"), socket.gethostname()
    assert callers.refusal([f"{own}:80"], [f"http://{own}"], "192.0.2.2") is None
    assert callers.refusal(["192.0.2.2:8080"], ["http://192.0.2.2:8080"], "192.0.2.2") is None
    assert "no name of this server" in (callers.refusal(["192.0.2.3:8080"], [], "192.0.2.2") or "")
    # Another server on the machine of who looks, at the same port.
    assert "foreign" in (callers.refusal([f"{own}:8080"], ["http://localhost:8080"], "192.0.2.2") or "")
    assert "no name" in (Callers.of("127.0.0.1").refusal([f"{own}:80"], [], "127.0.0.1") or "")
