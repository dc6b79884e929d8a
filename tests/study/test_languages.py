"""What participants read: complete in every language, with the same numbers in it."""

import re
import tomllib

import pytest

from hilbo.cli import doctor
from hilbo.errors import InputError
from hilbo.study.file.languages import LANGUAGES, language
from hilbo.study.file.protocols import SessionTable
from hilbo.study.file.reading import checked

FILE = """\
schema = 1
[study]
name = "foam"
responses = ["different", "similar", "close"]
[parameters.u]
low = 0
high = 1
[aggregation]
rule = "learnt-1"
[session]
language = "de"
"""


def study(text=FILE):
    return checked(tomllib.loads(text), "", lambda file: file)


@pytest.mark.parametrize("name", LANGUAGES)
def test_a_language_is_complete(name):
    here, english = language(name), language("en")
    assert list(here.texts) == list(english.texts) and here.texts["lang"] == name
    for key, text in here.texts.items():
        assert text.strip() and re.findall(r"{\w+}", text) == re.findall(r"{\w+}", english.texts[key]), key
    assert set(here.definitions) == set(english.definitions)
    assert name == "en" or (set(here.labels) == set(english.definitions) and not here.reviewed)


def test_a_study_speaks_its_language_and_keeps_its_own_words():
    session = study(FILE + '[session.texts]\nhello = "Moin."\n[session.labels]\nclose = "Genauso"\n').session
    assert session.text("hello") == "Moin." and session.text("start") == "Beginnen"
    assert [session.label(r) for r in ("different", "similar", "close")] == ["Verschieden", "Ähnlich", "Genauso"]
    assert "Referenz" in session.definition("close")


def test_english_is_as_it_was():
    session = SessionTable()
    assert (session.text("question"), session.label("close")) == (
        "What is the similarity between the test and the reference?",
        "Close",
    )
    assert session.definition("similar") == (
        "The tested haptic interface feels moderately similar to the reference haptic interface."
    )


def test_answers_without_words_are_named():
    file = study(FILE.replace('"different", "similar", "close"', '"bad", "good"'))
    assert file.session.untranslated(file.responses) == ["bad", "good"]
    assert study().session.untranslated(study().responses) == []


def test_doctor_says_what_nobody_has_read():
    (check,) = doctor._language(study())
    assert check.level == "note" and check.words == "German: no native speaker has reviewed these texts"
    (check,) = doctor._language(study(FILE.replace('"close"]', '"same"]')))
    assert check.words == "no German words for same"
    assert not list(doctor._language(study(FILE.replace('language = "de"', ""))))


def test_another_language_is_refused():
    with pytest.raises(InputError, match=r'session.language is "nl"; it must be one of "en", "de", "fr"; write for'):
        study(FILE.replace('"de"', '"nl"'))
