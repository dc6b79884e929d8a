"""The list of participants: several who write it at once, links to it, and times of consent."""

import datetime
import os
import threading
import time

import pytest

from hilbo.errors import InputError
from hilbo.session.plan import participants
from hilbo.session.plan.participants import add_person, check_consent, read_people
from hilbo.study.disk.lock import locked_folder


def person(name, consent="2026-05-04T10:15"):
    return {"participant": name, "consent_time": consent, "protocol_number": "1"}


def test_several_who_add_at_once_lose_nobody(tmp_path, monkeypatch):
    real = participants._read

    def slow(path):
        people = real(path)
        time.sleep(0.03)  # so that all others read before one has written, if nothing holds them
        return people

    monkeypatch.setattr(participants, "_read", slow)
    path = tmp_path / "new" / "participants.csv"
    threads = [threading.Thread(target=add_person, args=(path, person(f"P{i}"))) for i in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert set(read_people(path)) == {f"P{i}" for i in range(6)}


def test_a_list_that_another_holds_is_refused_after_a_while(tmp_path, monkeypatch):
    path = tmp_path / "participants.csv"
    monkeypatch.setattr(participants, "locked_folder", lambda folder: locked_folder(folder, 0.05))
    with locked_folder(tmp_path), pytest.raises(InputError, match="is being changed by another hilbo"):
        add_person(path, person("P01"))
    add_person(path, person("P01"))


def test_a_link_stays_one_and_the_list_behind_it_gets_the_row(tmp_path):
    (tmp_path / "shared").mkdir()
    add_person(tmp_path / "shared" / "list.csv", person("P01"))
    os.chmod(tmp_path / "shared" / "list.csv", 0o664)
    (tmp_path / "participants.csv").symlink_to("shared/list.csv")
    add_person(tmp_path / "participants.csv", person("P02"))
    assert (tmp_path / "participants.csv").is_symlink()
    assert set(read_people(tmp_path / "shared" / "list.csv")) == {"P01", "P02"}
    assert (tmp_path / "shared" / "list.csv").stat().st_mode & 0o777 == 0o664


def test_a_link_to_a_drive_that_is_missing_is_refused(tmp_path):
    (tmp_path / "participants.csv").symlink_to(tmp_path / "drive" / "list.csv")
    with pytest.raises(InputError, match=r"is a link to .*list\.csv, where no list is; connect its drive"):
        add_person(tmp_path / "participants.csv", person("P01"))
    assert (tmp_path / "participants.csv").is_symlink() and not (tmp_path / "drive").exists()


@pytest.mark.parametrize("ahead", ["2199-01-01", "9999-12-31T23:59-14:00"])
def test_nobody_has_agreed_in_the_future(tmp_path, ahead):
    path = tmp_path / "participants.csv"
    with pytest.raises(InputError, match=r"participants.csv: consent_time is .*, in the future"):
        add_person(path, person("P01", ahead))
    assert not path.exists()
    path.write_text(f"participant,consent_time,protocol_number\nP01,{ahead},1\nP02,2026-05-04,1\n")
    people = read_people(path)
    assert check_consent(people, "P02")["consent_time"] == "2026-05-04"
    with pytest.raises(InputError, match=r"participant P01: consent_time is .*, in the future"):
        check_consent(people, "P01")


def test_consent_of_a_zone_that_is_ahead_is_taken(tmp_path):
    now = datetime.datetime.now()
    for name, hours in (("P01", 14), ("P02", -14)):
        add_person(tmp_path / "list.csv", person(name, (now + datetime.timedelta(hours=hours)).isoformat()))
    add_person(tmp_path / "list.csv", person("P03", datetime.datetime.now(datetime.UTC).isoformat()))
    assert len(read_people(tmp_path / "list.csv")) == 3


def test_an_id_that_differs_in_capitals_only_is_refused(tmp_path):
    path = tmp_path / "participants.csv"
    add_person(path, person("P01"))
    with pytest.raises(InputError, match='participants "P01" and "p01" differ in capitals only'):
        add_person(path, person("p01"))
    assert list(read_people(path)) == ["P01"]


def test_an_age_of_5000_digits_is_refused_in_a_sentence(tmp_path):
    path = tmp_path / "participants.csv"
    path.write_text(f"participant,consent_time,protocol_number,age\nP01,,,{'1' * 5000}\n")
    with pytest.raises(InputError, match="it must be a whole number of years"):
        read_people(path)
