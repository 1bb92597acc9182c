"""One client has control while it sends messages, and no other connection can use its number."""

from __future__ import annotations

import pytest

from escape_hw.errors import LeaseHeld, RequestRefused
from escape_hw.remote.requests import RegisterClient
from escape_hw.server.frontend.lease import MAX_CLIENTS, LeaseManager, RegisteredClient


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def book(clock: Clock) -> LeaseManager:
    return LeaseManager(5.0, clock)


def comes(book: LeaseManager, number: int, route: bytes | None = None) -> RegisteredClient:
    client = f"{number:08x}-0000"
    registration = RegisterClient(
        client=client, schema_version=1, name=f"client {number}", host="here", pid=number
    )
    route = b"r%d" % number if route is None else route
    book.register_client(registration, route)
    return book.record_activity(client, route)


def test_the_second_is_told_who_has_it(book: LeaseManager) -> None:
    one, other = comes(book, 1), comes(book, 2)
    assert book.acquire(one, False).name == "client 1"
    with pytest.raises(LeaseHeld, match=r"client 1 on here \(process 1\) has had control since"):
        book.acquire(other, False)
    book.require(one)
    with pytest.raises(LeaseHeld):
        book.require(other)
    # Asked again, the holder keeps it.
    assert book.acquire(one, False).name == "client 1"


def test_it_is_taken_over_on_request_and_given_back(book: LeaseManager) -> None:
    one, other = comes(book, 1), comes(book, 2)
    book.acquire(one, False)
    book.acquire(other, True)
    book.release(one)  # what it has not, it cannot give back
    assert book.lease is not None
    assert book.lease.name == "client 2"
    book.release(other)
    assert book.lease is None
    with pytest.raises(LeaseHeld, match="no client has control"):
        book.require(one)


def test_a_holder_that_is_silent_loses_it(book: LeaseManager, clock: Clock) -> None:
    one = comes(book, 1)
    book.acquire(one, False)
    clock.now += 5.0
    book.expire()
    assert book.lease is not None
    book.record_activity(one.registration.client, one.route)
    clock.now += 5.1
    book.expire()
    assert book.lease is None
    clock.now += 3.0
    assert book.seconds_without_holder() == pytest.approx(3.0)
    book.acquire(comes(book, 2), False)
    assert book.seconds_without_holder() == 0.0


def test_no_connection_uses_the_number_of_another(book: LeaseManager) -> None:
    one = comes(book, 1)
    book.acquire(one, False)
    with pytest.raises(RequestRefused, match="belongs to another connection"):
        comes(book, 1, b"another connection")
    with pytest.raises(RequestRefused, match="not registered under that client number"):
        book.record_activity(one.registration.client, b"another connection")
    with pytest.raises(RequestRefused, match="not registered under that client number"):
        book.record_activity("0000000f-0000", b"x")


def test_too_many_are_refused_until_some_are_forgotten(book: LeaseManager, clock: Clock) -> None:
    for number in range(MAX_CLIENTS):
        comes(book, number)
    assert book.count == MAX_CLIENTS
    with pytest.raises(RequestRefused, match="clients are registered already"):
        comes(book, MAX_CLIENTS)
    clock.now += 61
    book.expire()
    assert book.count == 0
    comes(book, MAX_CLIENTS)


def test_the_lease_states_the_silence_of_its_holder(book: LeaseManager, clock: Clock) -> None:
    book.acquire(comes(book, 1), take_over=False)
    clock.now += 3.5
    lease = book.lease
    assert lease is not None
    assert (lease.silent_s, lease.expires_in_s) == (3.5, 1.5)
