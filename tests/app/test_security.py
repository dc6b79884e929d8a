"""Who gets in: one-time links, keys of two roles, and where a request may come from."""

import errno
import os
import stat

import pytest

from hilbo.app.wire.security import Gate, lan_addresses
from hilbo.errors import InputError

HERE = "127.0.0.1:8642"


@pytest.fixture
def gate(tmp_path):
    return Gate([HERE, "localhost:8642"], tmp_path / "keys")


def test_a_link_is_good_once_and_for_its_role(gate):
    role, key = gate.redeem(token := gate.invite("participant"))
    assert role == "participant"
    assert gate.redeem(token) is None
    assert gate.admits("participant", key)
    assert not gate.admits("experimenter", key)
    assert not gate.admits("participant", None)
    assert not gate.admits("participant", key[:-1])


def test_a_new_link_voids_the_one_that_nobody_has_used(gate):
    first, other = gate.invite("participant"), gate.invite("experimenter")
    second = gate.invite("participant")
    assert gate.redeem(first) is None
    assert gate.redeem(second)[0] == "participant"
    assert gate.redeem(other)[0] == "experimenter"


def test_a_key_is_known_in_the_bytes_of_a_request(gate):
    keys = {role: gate.redeem(gate.invite(role))[1] for role in ("participant", "experimenter")}
    mine = {role: b"Authorization: Bearer %s\r\n" % key.encode() for role, key in keys.items()}
    assert gate.role_in(b"authorization: bearer " + keys["experimenter"].encode()) == "experimenter"
    assert gate.role_in(mine["participant"]) == "participant"
    assert gate.role_in(mine["participant"] + mine["experimenter"]) == "experimenter"
    assert gate.role_in(mine["participant"].replace(b"\r", b"x")) is None
    assert gate.role_in(b"Cookie: hilbo_participant_8642=" + keys["participant"].encode()) is None
    assert gate.role_in(keys["participant"].encode()) is None
    assert gate.role_in(b"Bearer " + b"a" * 32) is None


def test_a_second_browser_ends_the_first(gate):
    _, first = gate.redeem(gate.invite("participant"))
    _, second = gate.redeem(gate.invite("participant"))
    assert not gate.admits("participant", first)
    assert gate.admits("participant", second)


def test_nobody_is_admitted_before_somebody_was_invited(gate):
    assert not gate.admits("participant", "")
    assert gate.redeem("") is None


def test_keys_outlive_the_server_and_only_their_owner_may_read_them(gate, tmp_path):
    _, key = gate.redeem(gate.invite("experimenter"))
    token = gate.invite("participant")
    assert stat.S_IMODE((tmp_path / "keys").stat().st_mode) == 0o600
    assert key not in (tmp_path / "keys").read_text()
    again = Gate([HERE], tmp_path / "keys")
    assert again.admits("experimenter", key)
    assert again.redeem(token) is None


def test_a_used_link_says_whom_it_let_in_until_another_did_and_after_a_restart(gate, tmp_path):
    first, second = gate.invite("stimulus"), None
    assert gate.let_in(first) is None
    _, key = gate.redeem(first)
    assert gate.let_in(first) == "stimulus" and gate.redeem(first) is None
    again = Gate([HERE], tmp_path / "keys")
    second = again.invite("stimulus")
    assert again.let_in(first) == "stimulus" and again.let_in(second) is None
    _, other = again.redeem(first, again=True)
    assert again.admits("stimulus", other) and not again.admits("stimulus", key)
    again.redeem(second)
    assert again.let_in(first) is None and again.redeem(first, again=True) is None


def test_a_link_that_could_not_be_opened_is_still_good_and_the_first_browser_stays(gate, tmp_path, monkeypatch):
    _, first = gate.redeem(gate.invite("participant"))
    token = gate.invite("participant")

    def full(*_, **options):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match="make room"):
        gate.redeem(token)
    monkeypatch.undo()
    assert gate.admits("participant", first)
    _, second = gate.redeem(token)
    assert gate.admits("participant", second)
    assert not gate.admits("participant", first)
    assert gate.redeem(token) is None


@pytest.mark.parametrize(
    "text",
    [
        *("", "[]", "{", '{"keys": 1}', '{"keys": {"experimenter": 1}, "links": []}', "\0"),
        *("[" * 100_000, "1" * 5000, '{"keys": {"experimenter": "é"}, "links": {"experimenter": "é"}}'),
    ],
    ids=range(9),
)
def test_a_damaged_file_of_keys_admits_nobody(tmp_path, text):
    (tmp_path / "keys").write_text(text, encoding="utf-8")
    gate = Gate([HERE], tmp_path / "keys")
    assert not gate.admits("experimenter", "1") and gate.let_in("1") is None
    _, key = gate.redeem(gate.invite("experimenter"))
    assert Gate([HERE], tmp_path / "keys").admits("experimenter", key)


GOOD = {"host": HERE, "origin": f"http://{HERE}", "sec-fetch-site": "same-origin"}


@pytest.mark.parametrize(
    ("changed", "refused"),
    [
        ({}, False),
        ({"host": "localhost:8642", "origin": "http://localhost:8642"}, False),
        ({"host": "LOCALHOST:8642"}, False),
        ({"host": "example.org"}, True),
        ({"host": "127.0.0.1:80"}, True),
        ({"host": None}, True),
        ({"origin": "http://example.org"}, True),
        ({"origin": "null"}, True),
        ({"origin": f"https://{HERE}"}, True),
        ({"origin": f"http://{HERE}.example.org"}, True),
        ({"sec-fetch-site": "cross-site"}, True),
        ({"sec-fetch-site": "same-site"}, True),
        ({"sec-fetch-site": "none"}, False),
        ({"origin": None}, False),
    ],
)
def test_where_a_request_comes_from(gate, changed, refused):
    headers = {name: value for name, value in (GOOD | changed).items() if value is not None}
    assert (gate.refuses(headers) is not None) == refused


def test_a_program_needs_no_origin_but_must_not_bring_another(gate):
    assert gate.refuses({"host": HERE}) is None
    assert gate.refuses({"host": HERE, "origin": "http://example.org"})


def test_addresses_of_networks_are_not_this_computers_own():
    assert all(not address.startswith("127.") for address in lan_addresses())
