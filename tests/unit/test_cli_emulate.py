"""``escape emulate``: lists, serves, reports protocol violations, and prints its address."""

from __future__ import annotations

import socket
import threading

import pytest

from escape_hw.cli.devices import emulate
from escape_hw.config.registry import EMULATORS, available


def test_without_a_name_it_lists(escape, document):
    assert "e727" in escape("emulate")[1].split()
    code, found, _ = document("emulate")
    assert code == 0
    assert found["emulators"] == list(available(EMULATORS))


def test_a_quiet_run_is_reported(document):
    code, found, err = document("emulate", "e727", "--port", 0, "--seconds", 0.1, "--option", "serial=7")
    assert code == 0
    assert err.startswith("e727: tcp 127.0.0.1:")
    assert found["address"].startswith("tcp 127.0.0.1:")
    assert (found["violations"], found["condition"], found["commands"]) == ([], "at rest", 0)
    assert {"schema", "system", "simulated", "seed"} <= set(found)


def test_a_serial_line_is_offered(document):
    code, found, _ = document("emulate", "e727", "--pty", "--seconds", 0)
    assert code == 0
    assert found["address"].startswith("pty /dev/")


def test_violations_are_reported_and_change_the_exit_code(document, monkeypatch):
    told = emulate._report_new_violations

    def careless(one, name, emulator, number):
        if emulator.controller.received_commands:
            return told(one, name, emulator, number)
        with socket.create_connection(("127.0.0.1", emulator.server.port), timeout=5) as wire:
            wire.sendall(b"MOV 1 5000\nERR?\n")
            assert wire.recv(64) == b"5\n"
        return told(one, name, emulator, number)

    monkeypatch.setattr(emulate, "_report_new_violations", careless, raising=True)
    monkeypatch.setattr(emulate, "_POLL_S", 0.5)
    code, found, err = document("emulate", "e727", "--port", 0, "--seconds", 0.05)
    assert code == 1
    assert found["complaints"] == found["violations"], "the key of version 0.1.0"
    assert found["violations"][0] == "MOV 1 5000: error 5 (servo off or axis unreferenced)"
    assert "e727: protocol violation: MOV 1 5000: error 5" in err


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("e272",), "did you mean 'e727'"),
        (("e727", "--option", "serial"), "write KEY=VALUE"),
        (("e727", "--host", "nowhere.invalid", "--port", 0), "(0: any) or --host"),
        (("asm", "--host", "nowhere.invalid", "--port", 0), "(0: any) or --host"),
        (("e727", "--option", "volume=11"), "--option volume: unknown"),
    ],
)
def test_what_is_wrong_is_refused(document, words, says):
    code, found, err = document("emulate", *words)
    assert code == 2
    assert says in err
    assert found["error"]["type"] == "ConfigError"


def test_ctrl_c_is_the_usual_end(document, monkeypatch):
    def interrupted(seconds):
        raise KeyboardInterrupt

    monkeypatch.setattr(emulate.time, "sleep", interrupted)
    code, found, err = document("emulate", "e727", "--port", 0)
    assert code == 0
    assert "e727: stopped" in err
    assert found["violations"] == []
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("e727")]
