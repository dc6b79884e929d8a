"""The file alone says of a study what the study itself says, and refuses the same mistakes in the same words."""

from pathlib import Path

import pytest

from hilbo.errors import InputError
from hilbo.study.config import Study
from hilbo.study.file.reading import StudyFile

DATA = Path("hilbo/data")
GEL = "[materials.gel.renderer]\nK_eff = 0.2\n[materials.gel.parameters.K1]\nhigh = 16.0\n"


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text((DATA / "paper.toml").read_text() + GEL)
    return path


def test_a_study_holds_its_file(path):
    file, study = StudyFile.load(path), Study.load(path)
    assert study.file == file and hash(study.file) == hash(file) and file.materials == ("gel",)
    assert study.material("gel").file == file.material("gel") != file
    assert (study.space.parameters, study.space.mechanics) == (file.space.parameters, file.space.mechanics)
    assert file.material("gel").space.mechanics.K_eff == 0.2 and file.material("gel").space.parameters[0].high == 16.0
    assert study.material("gel").space.mechanics.K_eff == 0.2


@pytest.mark.parametrize(
    ("was", "wrong"),
    [
        ("theta = 30.0", 'theta = "long"'),
        ("theta = 30.0", "theta = [1.0, 2.0]"),
        ("[-0.5, 0.5]", "[0.5, -0.5]"),
        ("noise = 0.5\n", ""),
        ("trials = 25", "trials = 2"),
        ("N = 101", "N = 100"),
        ("N = 101", "delay = nan"),
        ("N = 101", "delay = -1e-6"),
        ("N = 101", "delay = 0.00101"),
        ("N = 101", "delay = true"),
        ("K_eff = 0.2", "K_eff = -0.2"),
        ("high = 16.0", "high = 0.5"),
        ('rule = "bcm"', 'rule = "median"'),
        ("materials.gel.parameters.K1", "materials.gel.parameters.k1"),
    ],
)
def test_both_refuse_the_same_in_the_same_words(path, was, wrong):
    text = path.read_text()
    assert was in text
    path.write_text(text.replace(was, wrong))
    sentences = []
    for kind in (StudyFile, Study):
        with pytest.raises(InputError) as error:
            kind.load(path)
        sentences.append(str(error.value))
    assert sentences[0] == sentences[1] and sentences[0].startswith(f"{path}:")


def test_a_delay_of_0_is_no_part_of_a_studys_hash(path):
    paper = StudyFile.load(DATA / "paper.toml")
    assert paper.hash == "76f3e6c56626cc37" and "delay" not in paper.content
    text = path.read_text()
    hashes = []
    for delay in ("", "delay = 0", "delay = 0.0", "delay = 0.000271"):
        path.write_text(text.replace("N = 101", f"N = 101\n{delay}"))
        file = StudyFile.load(path)
        hashes.append(file.hash)
    assert len(set(hashes[:3])) == 1 and hashes[3] != hashes[0]
    assert file.space.mechanics.delay == file.material("gel").space.mechanics.delay == 0.000271


def test_which_sets_are_validated_is_no_part_of_a_studys_hash(path):
    """The table may change after the sessions: plans hold the sets themselves."""
    plain = StudyFile.load(path).hash
    text = path.read_text()
    path.write_text(text + "\n[validation]\nknown = 0.9\napart = 0.1\n")
    file = StudyFile.load(path)
    assert file.hash == plain and (file.validation.known, file.validation.apart) == (0.9, 0.1)
    path.write_text(text + "\n[validation]\nknown = 1.5\n")
    with pytest.raises(InputError, match=r"validation.known is 1.5; it must be a number above 0, at most 1"):
        StudyFile.load(path)


def test_what_has_to_be_computed_is_the_studys_to_refuse(path):
    path.write_text(path.read_text().replace("damping = 0.95", "damping = 0.001"))
    assert StudyFile.load(path).space.mechanics.damping == 0.001
    with pytest.raises(InputError, match=r"study.toml:\d+: renderer.damping is 0.001 N.s/m, with which no K1"):
        Study.load(path)
