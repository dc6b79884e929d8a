"""A small study from which people withdraw, and what must be true of its files whatever happened."""

import csv
import json
import random
import re
from pathlib import Path

from broken_disk import Process, together
from live import STUDY, Driver

from hilbo.cli.terminal.new_file import write_new
from hilbo.errors import InputError
from hilbo.session.log.event_log import EventLog, read_log
from hilbo.session.log.log_files import log_name
from hilbo.session.log.records import Header
from hilbo.session.plan.participants import add_person
from hilbo.session.plan.plan import make_plan
from hilbo.session.withdrawal.withdrawal import delete_participant
from hilbo.study.disk.lock import JOURNAL, LOCK
from hilbo.study.disk.new_folder import new_folder
from hilbo.study.file.plan_file import Block, Planned, plan_text, read_plan
from hilbo.study.results.listing import LIST, digest, list_files, listed

__all__ = ["PEOPLE", "SETS", "Schedule", "contents", "faults", "make_study", "naming", "older_log"]

SETS = {"best": {"u": 0.5, "v": 0.5}, "own-P02": {"u": 0.1, "v": 0.5}, "own-P01": {"u": 0.2, "v": 0.5}}
PEOPLE = ("P01", "P02", "P03", "P04")
_SETS = ("best", "own-P01", "own-P02", "s00000001 best", "s00000001 mid", "s00000003 best")


def older_log(folder, person, own="individual:P02"):
    """The log of somebody who compared a set that is called after P02, or otherwise."""
    block = Block("aggregate-best", 1, (Planned("aggregate", own),))
    sets = {"aggregate": SETS["best"], own: SETS["own-P02"]}
    header = Header(study=STUDY.file.hash, participant=person, session="3", seed=0, blocks=(block,), sets=sets)
    driver = Driver()
    driver.header, driver.state = header, type(driver.state).start(STUDY.file, header)
    driver.values = lambda trial, number: {"preferred": "a"}
    driver.step()
    driver.finish()
    with EventLog.create(folder / log_name(header), STUDY.file, header) as log:
        for event in driver.events:
            log.append(event)
    return folder / log_name(header)


def make_study(folder: Path, logs: list[Path]) -> None:
    """Lists, tables, a plan, results and copies of these logs. Of P01's and P02's own sets others have compared one."""
    for name in PEOPLE:
        row = {"participant": name, "consent_time": "2026-05-04T10:15", "protocol_number": "1"}
        add_person(folder / "people" / "participants.csv", row)
    _write(folder / "trials.csv", ["participant", "trial"], [[name, str(i)] for name in PEOPLE for i in (1, 2)])
    sets = [[name, name.replace("own-", "individual:") if "own" in name else "aggregate", ".5"] for name in _SETS]
    sets.append(["soft P02", "individual:P02", ".5"])
    for place in (folder, folder / "work"):  # the copy is rewritten after validation.csv
        place.mkdir(exist_ok=True)
        _write(place / "sets.csv", ["set_id", "source", "u"], sets)
    compared = [
        *(["P01", "1", "best", "own-P02"], ["P02", "1", "best", "own-P02"], ["P03", "1", "best", "own-P02"]),
        ["P03", "3", "best", "soft P02"],
        *(["P02", "2", "s00000001 best", "s00000001 mid"], ["P03", "2", "best", "s00000003 best"]),
    ]
    _write(folder / "validation.csv", ["participant", "trial", "set_a", "set_b"], compared)
    (folder / "plan.json").write_text(plan_text(make_plan(STUDY.file, PEOPLE)))
    (folder / "logs").mkdir()
    for path in logs:
        (folder / "logs" / path.name).write_bytes(path.read_bytes())
        (folder / "logs" / f".{path.name.removesuffix('.session.jsonl')}.keys").write_text("{}")
    for name, people in (("map", PEOPLE), ("other", ("P03", "P04"))):
        (folder / name).mkdir()
        (folder / name / "result.json").write_text(json.dumps({"participants": [{"participant": p} for p in people]}))
        (folder / name / "map.nc").write_bytes(b"\x89HDF\r\n\x1a\n" + " ".join(people).encode())
        list_files(folder / name, f"hilbo aggregate {name}.csv", "/lab")
    (folder / "tables").mkdir()
    (folder / "tables" / "dataset_description.json").write_text("{}")
    _write(folder / "tables" / "data.csv", ["participant", "trial"], [[name, "1"] for name in PEOPLE])
    list_files(folder / "tables", "hilbo export logs --out tables", "/lab")


def _write(path: Path, head: list[str], rows: list[list[str]]) -> None:
    path.write_text("\n".join(",".join(row) for row in [head, *rows]) + "\n")


def _rows(path: Path) -> list[dict[str, str]]:
    """The rows of a table; none where it went with its last row."""
    return list(csv.DictReader(path.read_text().splitlines())) if path.exists() else []


def contents(folder: Path, label: str = "withdrawn-") -> dict[str, bytes]:
    """Every file, with one word for the pseudonym and for what depends on it."""
    files = {}
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        text = path.read_bytes().replace(label.encode(), b"LABEL")
        files[path.relative_to(folder).as_posix()] = re.sub(rb'("hash": |")[0-9a-f"]{16,66}', b"DIGEST", text)
    return files


def naming(folder: Path, person: str) -> list[Path]:
    """The files whose name or bytes hold an id."""
    word = re.compile(rb"(?<![A-Za-z0-9])" + person.encode() + rb"(?![A-Za-z0-9])")
    every = (path for path in folder.rglob("*"))
    return [
        path
        for path in every
        if word.search(path.name.replace("_", " ").encode()) or (path.is_file() and word.search(path.read_bytes()))
    ]


def faults(folder: Path, gone: set[str], there: set[str]) -> list[str]:
    """What is wrong with a study after these people have withdrawn and these have not."""
    said = [f"{person} is in {path.relative_to(folder)}" for person in gone for path in naming(folder, person)]
    for path in folder.rglob("*"):
        if path.name in (LOCK, JOURNAL) or path.suffix in (".part", ".old"):
            said.append(f"{path.name} stays")
    listings = {"people/participants.csv": set(PEOPLE), "trials.csv": set(PEOPLE), "tables/data.csv": set(PEOPLE)}
    for name, people in listings.items():
        rows = _rows(folder / name)
        have = {row["participant"] for row in rows}
        said += [f"{person} is missing in {name}" for person in (people & there) - have]
        said += [f"{name} has a row that is not whole" for row in rows if None in row.values() or None in row]
    sets = {row["set_id"] for row in _rows(folder / "sets.csv")}
    named = {row[k] for row in _rows(folder / "validation.csv") for k in ("set_a", "set_b")}
    said += [f"{name} is in no sets.csv" for name in named - sets]
    planned = {row.participant for row in read_plan(folder / "plan.json").participants}
    said += [] if len(planned) == len(PEOPLE) else ["the plan has lost a row"]
    said += [f"{p} is missing in the plan" for p in there & set(PEOPLE) if p not in planned]
    for path in folder.rglob("*.session.jsonl"):
        read_log(path)
    for path in folder.rglob(LIST):
        files = listed(path.parent).files
        said += [
            f"{path.parent.name}/{n} is not as listed" for n, was in files.items() if digest(path.parent / n) != was
        ]
    return said


class Schedule:
    """Commands that come at once; each may be killed once at a change of the disk, and is given until it is done."""

    def __init__(self, folder: Path, rng: random.Random):
        self.folder, self.rng = folder, rng
        self.gone, self.there = set(), set(PEOPLE)

    def run(self) -> list[str]:
        """What is wrong afterwards."""
        kinds = ["delete", *self.rng.choices(("delete", "add", "export", "init"), k=self.rng.choice((1, 2, 3)))]
        together(self.rng, [getattr(self, kind)(number) for number, kind in enumerate(kinds)])
        listed = {row["participant"] for row in _rows(self.folder / "people" / "participants.csv")}
        missing = [f"{name} is not in the list" for name in self.there - self.gone - listed]
        return faults(self.folder, self.gone, self.there - self.gone) + missing

    def _until_done(self, command):
        last = self.rng.choice((None, self.rng.randrange(60)))

        def run(turn):
            at = last
            for _ in range(200):
                try:
                    if Process(command, at, turn).run():
                        return
                except InputError as error:
                    if "nothing of participant" in str(error) or "exists already" in str(error):
                        return
                    turn()
                at = None
            raise AssertionError("it is never done")

        return run

    def delete(self, number):
        person = PEOPLE[number]
        self.gone.add(person)
        return self._until_done(lambda: delete_participant(self.folder, person))

    def add(self, number):
        row = {"participant": f"Q{number}", "consent_time": "2026-05-04T10:15", "protocol_number": "1"}
        self.there.add(f"Q{number}")
        path = self.folder / "people" / "participants.csv"

        def command():
            try:
                add_person(path, row)
            except InputError as error:
                if "is there already" not in str(error):  # it was killed after that
                    raise

        return self._until_done(command)

    def export(self, number):
        out = self.folder / "exports" / f"tables{number}"

        def free():
            if out.exists():
                raise InputError("exists already")

        def command():
            with new_folder(out, free) as made:
                (made / "data.csv").write_bytes((self.folder / "trials.csv").read_bytes())
                list_files(made, "hilbo export logs", "/lab")

        return self._until_done(command)

    def init(self, number):
        return self._until_done(lambda: write_new(self.folder / "study.toml", f"{number}" * 9, False))
