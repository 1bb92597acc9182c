"""Keys: created once, readable for their user only, required before a server listens on the network."""

from __future__ import annotations

import shlex
import stat
import warnings
from pathlib import Path

import pytest

from escape_hw.errors import ConfigError, StorageError
from escape_hw.remote import keys
from escape_hw.remote.address import find_server, is_loopback, resolve, running_servers, runtime_folder

OTHER = "X8nS7Q1AbBe5qEMxbWkJSWPHmZc84UmvUYdVdpc1"


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A home without keys and servers."""
    tmp_path.chmod(0o700)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path


def test_keys_are_made_once_and_are_the_users_own(document) -> None:
    code, made, _ = document("keys", "make")
    assert code == 0
    assert len(made["public"]) == 40
    for path in Path(made["folder"]).iterdir():
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert document("keys", "make")[1]["public"] == made["public"]
    assert document("keys", "make", "--replace")[1]["public"] != made["public"]


def test_a_key_is_printed_as_a_shell_accepts_it(escape, document) -> None:
    public = document("keys", "make")[1]["public"]
    lines = [line for line in escape("keys", "make")[1].splitlines() if "escape keys" in line]
    assert [shlex.split(line.partition("escape ")[2])[-1] for line in lines] == [public] * 2


def test_an_address_without_a_port_is_refused(escape) -> None:
    code, _, said = escape("serve", "razor-shwfs", "--bind", "0.0.0.0")
    assert code == 2
    assert "--bind 0.0.0.0 needs --port" in said


def test_a_secret_key_that_others_may_read_is_not_used() -> None:
    keys.make_keys()
    (keys.keys_folder() / "own.secret").chmod(0o644)
    with pytest.raises(StorageError, match="other users can read it; make new keys"):
        keys.own_keys()


def test_other_addresses_than_the_loopback_need_keys_and_an_allowed_client(escape, document) -> None:
    serve = ("serve", "razor-shwfs", "--port", 40001, "--bind", "0.0.0.0")
    code, _, said = escape(*serve)
    assert code == 2
    assert "make them with 'escape keys make'" in said
    document("keys", "make")
    code, _, said = escape(*serve)
    assert code == 2
    assert "no client is allowed; add one with 'escape keys allow NAME KEY'" in said
    assert find_server("razor-shwfs") is None
    assert running_servers() == ()


def test_a_key_may_begin_with_a_minus_sign(document) -> None:
    key = f"-{OTHER[1:]}"
    assert document("keys", "allow", "alice", key)[0] == 0
    assert document("keys", "trust", "bench.example.org", key)[0] == 0
    assert document("keys", "list")[1]["allowed"] == {"alice": key}
    assert document("keys", "allow", "bob", "--nonsense")[0] == 2


def test_clients_are_let_in_and_out_by_name(document) -> None:
    assert document("keys", "allow", "alice", OTHER)[0] == 0
    assert document("keys", "trust", "bench.example.org", OTHER)[0] == 0
    found = document("keys", "list")[1]
    assert found["allowed"] == {"alice": OTHER}
    assert found["servers"] == {"bench.example.org": OTHER}
    assert found["public"] is None
    assert document("keys", "remove", "alice")[0] == 0
    assert document("keys", "remove", "alice")[0] == 2
    assert keys.allowed_keys() == {}


@pytest.mark.parametrize("name", ["../alice", "", "a/b", ".hidden", "x" * 65])
def test_names_stay_in_their_folder(name: str) -> None:
    with pytest.raises(ConfigError, match="is not a valid name"):
        keys.allow(name, OTHER)


@pytest.mark.parametrize("key", ["", "short", OTHER + "1", " " * 40, "é" * 40, "~" * 40])
def test_what_is_no_key_is_refused(key: str) -> None:
    with pytest.raises(ConfigError, match="is not a key"):
        keys.allow("alice", key)


def test_a_client_is_told_which_key_is_missing() -> None:
    assert keys.client_keys("ipc:///anything") is None
    assert keys.client_keys("tcp://127.0.0.1:5555") is None
    with pytest.raises(ConfigError, match="far requires a key; make one"):
        keys.client_keys("tcp://far:5555")
    own = keys.make_keys()
    with pytest.raises(
        ConfigError, match="the key of far is unknown; add it with 'escape keys trust far KEY'"
    ):
        keys.client_keys("tcp://far:5555")
    keys.trust("far", OTHER)
    assert keys.client_keys("tcp://far:5555") == (OTHER.encode(), own.public, own.secret)


def test_addresses() -> None:
    assert [is_loopback(host) for host in ("127.0.0.1", "127.1.2.3", "localhost", "[::1]")] == [True] * 4
    assert not any(map(is_loopback, ("0.0.0.0", "10.0.0.1", "*", "localhost.example.org")))
    assert resolve("tcp://far:5555").events == "tcp://far:5556"
    for wrong in ("tcp://far", "tcp://far:0", "tcp://far:70000", "http://far:5555", "tcp://a/b:5555"):
        with pytest.raises(ConfigError, match="is no address"):
            resolve(wrong)


def test_a_runtime_folder_that_others_may_write_to_is_not_used(home: Path) -> None:
    (home / "escape").mkdir(mode=0o700)
    (home / "escape").chmod(0o777)
    with pytest.raises(StorageError, match="other users can write there"):
        find_server("razor-shwfs")


def test_no_warning_where_the_login_session_has_no_runtime_folder(home, monkeypatch, recwarn) -> None:
    def fall_back(*_: object, **__: object) -> str:
        warnings.warn("XDG_RUNTIME_DIR is not set, falling back", RuntimeWarning, stacklevel=2)
        return str(home / "fallen back")

    monkeypatch.setattr("escape_hw.remote.address.platformdirs.user_runtime_dir", fall_back)
    assert runtime_folder() == home / "fallen back"
    assert not recwarn.list


def test_a_runtime_folder_of_another_user_is_refused(escape, monkeypatch: pytest.MonkeyPatch) -> None:
    reason = "runtime directory /tmp/runtime-0 is owned by uid 1001, not 0; set XDG_RUNTIME_DIR instead"

    def refuse(*_: object, **__: object) -> str:
        raise PermissionError(reason)

    monkeypatch.setattr("escape_hw.remote.address.platformdirs.user_runtime_dir", refuse)
    code, _, err = escape("serve", "razor-shwfs", "--mode", "sim")
    assert (code, err.strip()) == (2, f"error: {reason}")
