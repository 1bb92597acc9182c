"""Every failure of the link to an adaptive secondary ends in the documented state and is reported."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from asm_bench import RawClient, driver, emulator, hello, port_of, wait_for

from escape_drivers.asm.mirror import AsmMirror
from escape_hw.api.adaptive_secondary import ShellState
from escape_hw.errors import DeviceError, DeviceLost
from escape_sim.emulators.asm import protocol as asm_wire
from escape_sim.emulators.asm.emulator import AsmEmulator

#: Requests of the session below; more are tried than it has.
N_CALLS = 34
#: Off and at rest; set, the shell floats flat under its own control and follows no commands.
SAFE = (ShellState.OFF, ShellState.RESTED, ShellState.SET)


def session(mirror: AsmMirror) -> None:
    """All requests to a driver."""
    with mirror:
        for k in range(3):
            mirror.send(0.01 * k * np.ones(336))
        assert mirror.health.fault == ""
        mirror.measured_positions()
        mirror.flatten()


def ends_safe(fault: str) -> tuple[str, str, AsmEmulator]:
    """A session with a fault: what the driver said, and where the mirror was in the end."""
    with emulator(hold_s=0.3, rest_s=1.0, fault=fault) as made:
        mirror = driver(port_of(made), reply_s=1.0)
        said = ""
        try:
            session(mirror)
        except DeviceError as error:
            said = str(error)
        assert not mirror.is_open
        wait_for(lambda: made.controller.shell.state in SAFE, f"{fault}: the shell lies at rest")
        return said, str(made.controller.shell.state), made


@pytest.mark.slow
def test_a_reset_at_every_call_ends_at_rest_and_is_reported() -> None:
    with ThreadPoolExecutor(12) as pool:
        results = list(pool.map(ends_safe, [f"reset@{n}" for n in range(N_CALLS)]))
    met = [n for n, (_, _, made) in enumerate(results) if made.server.requests > n]
    assert len(met) >= 20, "the session is shorter than it was thought"
    for n in met:
        said, _, made = results[n]
        assert "link to 127.0.0.1" in said, f"reset at call {n}: {said!r}"
        assert "open it again" in said
        # Nothing came twice.
        counters = [what for name, what in made.server.calls if name == "COMMAND"]
        assert len(counters) == made.controller.applied


@pytest.mark.parametrize(
    "fault",
    [
        *("close", "truncate", "crc", "stall", "garbage"),
        # The driver waits for the same time as for a peer that stalls.
        *(pytest.param(fault, marks=pytest.mark.slow) for fault in ("stale", "delay:3")),
    ],
)
def test_every_fault_of_the_link_is_reported_and_ends_at_rest(fault: str) -> None:
    said, _, _ = ends_safe(f"{fault}@12")
    assert "link to 127.0.0.1" in said
    assert "open it again" in said


def test_an_answer_that_comes_twice_does_no_harm() -> None:
    said, state, made = ends_safe(",".join(f"double@{n}" for n in range(0, 40, 3)))
    assert said == ""
    assert state == ShellState.RESTED
    assert made.violations == ()


# --------------------------------------------------------------------- a link that comes back
def broken(mirror: AsmMirror, made: AsmEmulator) -> None:
    """Cut the owner's connection as a router would."""
    wait_for(lambda: made.server.owner is not None, "there is an owner")
    owner = made.server.owner
    assert owner is not None
    assert made._loop is not None
    made._loop.call_soon_threadsafe(owner.abort)
    wait_for(lambda: made.server.owner is not owner, "the connection is cut")


def test_a_link_comes_back_by_itself_and_nothing_is_sent_again() -> None:
    with emulator() as made, driver(port_of(made), heartbeat_s=0.02, retry_s=0.05) as mirror:
        mirror.send(0.02 * np.ones(336))
        sent = made.controller.applied
        broken(mirror, made)
        wait_for(lambda: made.server.owner is not None, "the driver has connected again")
        wait_for(lambda: mirror._link.is_up, "and has been welcomed")
        assert made.controller.applied == sent
        assert made.controller.shell.state is ShellState.RUNNING
        wait_for(lambda: mirror.shape[0] == pytest.approx(0.02), "the guard knows the shape")
        assert mirror.send(0.03 * np.ones(336)).guard.slewed == 0
        assert made.controller.applied == sent + 1
        assert not [c for c in made.violations if "refused" in c]


def test_a_command_into_a_broken_link_is_lost_and_is_reported() -> None:
    with emulator() as made:
        mirror = driver(port_of(made)).open()
        sent = made.controller.applied
        broken(mirror, made)
        shape = mirror.shape
        for _ in range(2):
            with pytest.raises(DeviceLost, match=r"nothing is sent twice, .* open it again"):
                mirror.send(0.02 * np.ones(336))
        assert np.array_equal(mirror.shape, shape)
        assert made.controller.applied == sent
        with pytest.raises(DeviceLost):
            mirror.close()
        with mirror:
            assert mirror.state is ShellState.RUNNING


def test_numbers_begin_anew_after_four_thousand_million() -> None:
    with emulator() as made:
        mirror = driver(port_of(made))
        mirror.lift = False
        with mirror:
            mirror._link._sequence = mirror._link._counter = 0xFFFFFFFF - 30
            # As a peer that has counted along.
            assert made.server.owner is not None
            made.server.owner.sequence_in = made.server.counter = 0xFFFFFFFF - 31
            mirror.go_to(ShellState.RUNNING)
            for _ in range(60):
                mirror.send(np.zeros(336))
            assert 0 < mirror._link._sequence < 100
            assert 0 < mirror._link._counter < 100
        assert made.violations == ()


def test_a_mirror_that_returns_contaminated_is_not_controlled() -> None:
    with emulator() as made:
        mirror = driver(port_of(made), heartbeat_s=0.02, retry_s=0.05).open()
        made.inject("contaminate:12")
        broken(mirror, made)
        wait_for(
            lambda: "came back, but actuators [12]" in mirror._link.reason, "the contamination is noticed"
        )
        with pytest.raises(DeviceLost, match=r"disabled = \[12, 259"):
            mirror.send(np.zeros(336))
        with pytest.raises(DeviceLost):
            mirror.close()


def test_a_client_that_reconnects_replaces_its_own_half_open_connection() -> None:
    with emulator() as made:
        mirror = driver(port_of(made), reply_s=0.3, heartbeat_s=0.02, retry_s=0.05).open()
        first = made.server.owner
        assert first is not None
        first._is_stalled = True  # replies are lost without an error on either side
        wait_for(lambda: made.server.owner not in (None, first), "the same client owns it anew")
        wait_for(lambda: mirror._link.is_up, "the link is up")
        mirror.close()
        assert made.controller.shell.state is ShellState.RESTED


def test_a_rest_while_the_link_was_gone_is_not_undone() -> None:
    with emulator(hold_s=0.05, rest_s=0.2) as made:
        mirror = driver(port_of(made), heartbeat_s=0.02, retry_s=1.0).open()
        broken(mirror, made)
        wait_for(lambda: made.controller.shell.state is ShellState.RESTED, "the watchdog rests the shell")
        wait_for(lambda: made.server.owner is not None and mirror._link.is_up, "the link is back")
        assert mirror.state is ShellState.RESTED
        with pytest.raises(
            DeviceError, match=r"is rested and follows no commands.*go_to\(ShellState.RUNNING\)"
        ):
            mirror.send(np.zeros(336))
        mirror.go_to(ShellState.RUNNING)
        mirror.send(np.zeros(336))
        mirror.close()


# --------------------------------------------------------------------- no peer
@contextlib.contextmanager
def blackhole() -> Iterator[int]:
    """A port that takes connections and never says a word."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()[1]


def test_a_port_that_never_answers_is_reported() -> None:
    with blackhole() as port:
        mirror = driver(port, reply_s=0.2)
        with pytest.raises(DeviceLost, match=r"no answer within 0\.2 s"):
            mirror.open()
        assert not mirror.is_open
        with pytest.raises(DeviceLost, match="no answer within"):
            mirror.observe_health()


def test_a_closed_port_is_reported() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with pytest.raises(DeviceLost, match=r"no answer at 127.0.0.1:\d+ .* check host, port"):
        driver(port).open()


def test_a_peer_with_another_protocol_is_reported() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server, ThreadPoolExecutor(1) as pool:

        def greet() -> None:
            with server.accept()[0] as client:
                client.sendall(b"220 mail.example ESMTP\r\n")
                client.recv(1 << 16)

        answered = pool.submit(greet)
        with pytest.raises(DeviceLost, match="begins with b'220 ', not b'ASM1'"):
            driver(server.getsockname()[1]).open()
        answered.result()


def test_an_unplugged_mirror_is_reported_and_recovers() -> None:
    with emulator() as made:
        port = port_of(made)
        mirror = driver(port).open()
        made.stop()
        with pytest.raises(DeviceLost):
            mirror.send(np.zeros(336))
        with pytest.raises(DeviceLost):
            mirror.close()
        made._port = port
        made.start()
        with mirror:
            mirror.send(np.zeros(336))


# --------------------------------------------------------------------- the mirror stops itself
def test_after_silence_the_shape_is_held_and_then_the_shell_rested() -> None:
    with emulator(hold_s=0.1, rest_s=1.0) as made:
        mirror = driver(port_of(made), heartbeat_s=600.0).open()
        wait_for(
            lambda: made.controller.holding or made.controller.shell.state is ShellState.RESTED, "it holds"
        )
        wait_for(lambda: made.controller.shell.state is ShellState.RESTED, "it rests")
        assert "no frame for 1 s" in made.controller.last_event
        wait_for(lambda: any("was silent for 1 s" in one for one in made.violations), "it is recorded")
        with pytest.raises(DeviceError, match="link to"):
            mirror.send(np.zeros(336))
        with pytest.raises(DeviceError):
            mirror.close()


def test_heartbeats_keep_a_shell_floating() -> None:
    """They renew the time of the last frame, whose age holds and rests a shell, see the test above."""
    with emulator() as made, driver(port_of(made), heartbeat_s=0.01) as mirror:
        owner = made.server.owner
        assert owner is not None
        for _ in range(3):
            last_s = owner.last_frame_s
            wait_for(lambda before=last_s: owner.last_frame_s > before, "a heartbeat")
        assert made.server.calls[-1][0] == "HEARTBEAT"
        assert mirror.state is ShellState.RUNNING
        assert made.violations == ()


def test_a_panic_is_latched_until_an_operator_clears_it() -> None:
    with emulator() as made:
        with driver(port_of(made)) as mirror:
            made.inject("trip")
            with pytest.raises(DeviceError, match=r"fault latched: panic \(scripted\); .* recover\(\)"):
                mirror.send(np.zeros(336))
            with pytest.raises(DeviceError, match="fault latched"):
                mirror.go_to(ShellState.RUNNING)
        # Neither closing nor opening clears it.
        with pytest.raises(DeviceError, match="fault latched"):
            driver(port_of(made)).open()
        with driver(port_of(made), lift=False) as mirror:
            assert mirror.health.fault == "panic (scripted)"
            mirror.recover()
            assert mirror.state is ShellState.RESTED
            mirror.go_to(ShellState.RUNNING)
            mirror.send(np.zeros(336))


def test_a_cause_that_persists_is_not_cleared() -> None:
    with emulator() as made, driver(port_of(made)) as mirror:
        made.inject("overcurrent:40")
        wait_for(lambda: mirror.state is ShellState.FAULT, "the coil is noticed")
        with pytest.raises(DeviceError, match="the fault persists: coil 40 over current"):
            mirror.recover()
        made.inject("clear")
        mirror.recover()
        mirror.go_to(ShellState.RUNNING)


def test_dust_on_the_way_stops_the_work_and_states_what_to_configure() -> None:
    with emulator() as made:
        with driver(port_of(made)) as mirror:
            made.inject("contaminate:30")
            with pytest.raises(DeviceError, match=r"changed a command \(clipped, 1 actuators\)"):
                mirror.send(0.01 * np.ones(336))
        with pytest.raises(DeviceError, match=r"disabled = \[30, 259"):
            driver(port_of(made)).open()


def test_a_fault_is_received_while_nothing_is_sent() -> None:
    with emulator() as made, driver(port_of(made), heartbeat_s=0.02) as mirror:
        made.inject("trip")
        wait_for(lambda: mirror._last_state is ShellState.FAULT, "the sign of life has brought the news")
        mirror.recover()


def test_an_owner_that_hangs_loses_ownership() -> None:
    with emulator(hold_s=0.1, rest_s=0.3) as made, RawClient(port_of(made)) as stopped:
        stopped.send(hello(1))
        stopped.reply(asm_wire.WELCOME)
        wait_for(lambda: made.server.owner is None, "its time is over")
        assert stopped.hung_up()


def test_a_rest_by_the_watchdog_is_reported_with_its_reason() -> None:
    with emulator() as made, driver(port_of(made)) as mirror:
        made.inject("watchdog")
        with pytest.raises(DeviceError, match=r"is rested and follows no commands \(the watchdog rested it"):
            mirror.send(np.zeros(336))
        mirror.go_to(ShellState.RUNNING)
        mirror.send(np.zeros(336))
        assert made.violations == ()
