"""Levels in a live session: whoever presents is told their names and confirms them; another one voids the trial."""

import msgspec
import pytest
import xarray as xr
from live_server import check_blinding, refused
from live_stimulus import SETS, SINGLE, LiveLevels, all_answered

from hilbo.app.pages.log_words import table
from hilbo.app.pages.slices import Maps
from hilbo.app.rehearsal.robot import browser, find_browser
from hilbo.app.rehearsal.stand_in import StandIn
from hilbo.app.wire.lines import lines_of
from hilbo.session.export.netcdf import netcdf
from hilbo.session.export.psych_ds import psych_ds
from hilbo.session.export.tables import sets_table, trials_table
from hilbo.study.cohort import cohort_of
from hilbo.study.file.plan_file import Block

LEVELS = ("silk", "wood", "smooth stone")


def test_names_are_told_confirmed_and_written(tmp_path):
    blocks = (msgspec.structs.replace(SINGLE[0], phase="optimisation"),)  # a warm-up is in no file
    with LiveLevels(tmp_path, blocks=blocks) as live, live.present() as program:
        live.begin()
        for _ in range(3):
            live.answer()
        live.until(lambda view: view["phase"] == "done")
        assert [order.values["texture"] for order in program.shown if order.show == "test"] == list(LEVELS)
        assert program.stimulus.parameters[1] == {"name": "texture", "levels": list(LEVELS)}
        assert [event.data["values"]["texture"] for event in live.events("sent")] == [0.0, 1.0, 2.0]
        state = live.replayed()
        assert trials_table([state])["texture"].tolist() == list(LEVELS)
        live.replays()
    netcdf([state], tmp_path / "trials.nc", live.study.file)
    with xr.open_datatree(tmp_path / "trials.nc", engine="h5netcdf") as tree:
        texture = tree["constant_data"]["texture"]
        assert texture.values.tolist() == texture.attrs["levels"] == list(LEVELS)
    psych_ds([state], tmp_path / "out", live.study.file)
    words = (tmp_path / "out" / "dataset_description.json").read_text()
    assert "value of the parameter, one of silk, wood, smooth stone" in words


@pytest.mark.deep  # it compiles a step
def test_a_session_that_chooses_is_aggregated_from_its_table(tmp_path):
    with LiveLevels(tmp_path, blocks=(Block("optimisation", 6),)) as live, live.present() as program:
        live.begin()
        for _ in range(6):
            live.answer()
        live.until(lambda view: view["phase"] == "done")
        chosen = [order.values["texture"] for order in program.shown if order.show == "test"]
        frame = trials_table([live.replayed()])
        assert set(chosen) <= set(LEVELS) and frame["texture"].tolist() == chosen
        cohort = cohort_of(frame, live.study)
        assert [LEVELS[int(k)] for k in cohort.physical[0, :, 1]] == chosen
        assert [row["cells"][4] for row in table(live.replayed())["rows"]] == chosen[::-1]
        live.replays()


@pytest.mark.parametrize("by", ["program", "person"])
def test_a_stand_in_presents_and_knows_what_by_place_in_the_list(tmp_path, by):
    more = 'by = "person"\n' if by == "person" else ""
    with LiveLevels(tmp_path, more=more, blocks=SINGLE) as live:
        role = live.study.file.stimulus.role
        with StandIn(live.study.file, live.place.link(role), role) as presents:
            all_answered(live)
            assert [presents.presented(k)["a"] for k in (1, 2, 3)] == list(live.sets().values())
            assert presents.presented(4) == {}


def test_another_level_voids_the_trial_and_what_is_none_is_refused(tmp_path):
    with LiveLevels(tmp_path, blocks=SINGLE) as live:
        program = live.by_hand()
        live.begin()
        order = program.asked(live)
        assert order["values"]["texture"] == "silk"
        for wrong in ("glass", 1.0, "0"):
            with refused(409, "it must be one of silk, wood, smooth stone."):
                program.report("presented", values=order["values"] | {"texture": wrong})
        assert not live.events("sent") and not live.events("missed")
        with refused(409, "texture is confirmed as wood, and silk was requested."):
            program.report("presented", values=order["values"] | {"texture": "wood"})
        whole = live.until(lambda v: any(t["voided"] for t in v["whole"]["trials"]), live.whole)["whole"]
        assert "texture is confirmed as wood" in next(t for t in whole["trials"] if t["voided"])["voided"]["reason"]


def test_comparisons_are_blind_and_their_sets_are_written_by_name(tmp_path):
    with LiveLevels(tmp_path, repeats=1) as live, live.present():
        live.begin()
        for _ in range(3):
            live.answer()
        view = live.until(lambda view: view["phase"] == "done")
        check_blinding(str(view), live.hub.state, "texture", "hue", *LEVELS)
        sets = sets_table([live.replayed()]).set_index("set_id")
        assert sets["texture"].to_dict() == dict(zip(SETS, LEVELS, strict=True))


def test_lines_have_the_names():
    said = {"parameters": [{"name": "texture", "levels": list(LEVELS)}], "values": {"texture": LEVELS[2], "hue": 1.5}}
    lines = lines_of(200, said).splitlines()
    assert lines[1:] == ["levels\ttexture\tsilk\twood\tsmooth stone", "value\ttexture\tsmooth stone", "value\thue\t1.5"]


@pytest.mark.deep  # it starts a browser
@pytest.mark.skipif(find_browser() is None, reason="needs playwright and Chromium (Debian: chromium)")
def test_the_preparer_chooses_among_the_names(tmp_path):
    by, blocks = 'by = "person"\nexperimenter_sees = true\n', (Block("optimisation", 4),)
    with LiveLevels(tmp_path, within=600.0, more=by, blocks=blocks, maps=Maps) as live, browser() as program:
        page = program.new_context(viewport={"width": 1024, "height": 768}).new_page()
        page.goto(live.place.link("preparer"))
        page.wait_for_url("**/preparer")
        chosen = []

        def acted():
            view, phase = live.view(), page.evaluate("document.body.dataset.phase")
            if view["may"]["begin"]:
                live.participant.post("/api/participant/begin", {})
            elif view["questions"]:
                live.answer(view)
            if phase in ("ready", "present", "away"):
                page.wait_for_timeout(350)
                if phase == "present" and page.evaluate("order.show") == "test":
                    assert page.locator("#setting select option").all_inner_texts() == list(LEVELS)
                    chosen.append(page.locator("#setting select").input_value())
                    page.screenshot(path=tmp_path / "preparer.png")
                page.click("#go")
            return view

        live.until(lambda view: view["phase"] == "done", acted)
        experimenter = program.new_context(viewport={"width": 1440, "height": 900}).new_page()
        experimenter.goto(live.place.link("experimenter"))
        experimenter.wait_for_selector("#log li")
        experimenter.wait_for_timeout(1500)
        experimenter.screenshot(path=tmp_path / "experimenter.png", full_page=True)
        assert [LEVELS[int(e.data["values"]["texture"])] for e in live.events("sent")] == chosen and len(chosen) == 4
