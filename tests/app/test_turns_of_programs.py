"""Which of several programs with one key presents: the rig against a model of a few lines, in a time of the test's."""

import asyncio

import pytest
from hypothesis import given
from hypothesis import strategies as st
from live_stimulus import TEXT

from hilbo.app.rigs.stimulus_rig import OverError, StimulusRig
from hilbo.app.wire.messages import Hello, Report
from hilbo.study.file.reading import StudyFile

SILENCE = 1.05  # s; no sum of the tenths that pass
DEEDS = st.tuples(st.integers(0, 2), st.sampled_from(["hello", "again", "report"]), st.integers(0, 12))


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    file = tmp_path_factory.mktemp("study") / "study.toml"
    file.write_text(TEXT.format(within=1.0, silence=SILENCE))
    return StudyFile.load(file)


class Paced(asyncio.SelectorEventLoop):
    """A loop whose time is `now`."""

    now = 0.0

    def time(self):
        return self.now

    def did(self, deed):
        """What came of it, None where it was refused; what is due by now has happened before."""
        self.run_until_complete(asyncio.sleep(0))
        try:
            return self.run_until_complete(deed)
        except OverError:
            return None


@given(st.lists(DEEDS, max_size=20))
def test_who_is_heard_presents_and_nobody_with_the_same_key_takes_it_away(study, deeds):
    loop = Paced()
    try:
        rig = StimulusRig(study, "tag")
        said = {"name": "one", "version": "", "force": False, "neutral_within_s": 10.0}
        runs, holder, heard = ["", "", ""], None, 0.0
        for who, what, tenths in deeds:
            loop.now += tenths / 10
            free = holder is None or loop.now - heard > SILENCE
            if what != "report":  # "again": it had a run, and says which
                own = runs[who] if what == "again" else ""
                taken, may = loop.did(rig.hello(Hello(**said, run=own), "key")), free or (bool(own) and holder == who)
                runs[who] = taken["run"] if taken else runs[who]
            else:
                report = Report(run=runs[who] or "none", order=rig.order.number, state="neutral")
                taken, may = loop.did(rig.report(report)), not free and holder == who
            assert (taken is not None) == may
            if may:
                holder, heard = who, loop.now
        rig.hang_up()
    finally:
        loop.close()
