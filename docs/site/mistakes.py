"""Common mistakes and the error message of each: `python docs/site/mistakes.py` writes the page."""

import tempfile
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path

from hilbo.errors import InputError
from hilbo.study.cohort import read_trials
from hilbo.study.config import Study
from hilbo.study.file.reading import checked

PAGE = Path(__file__).parents[1] / "guides" / "mistakes.md"
STUDY = """\
schema = 1
[study]
name = "memory foam"
responses = ["different", "similar", "close"]
[parameters.K1]
low = 1.0
high = 32.0
unit = "N/mm"
[parameters.B1]
low = 0.001
high = 32.0
[parameters.alpha]
low = 0.01
high = 0.99
[renderer]
K_eff = 0.44
damping = 0.95
[gp]
theta = 30.0
variance = 1.0
thresholds = [-0.5, 0.5]
noise = 0.5
"""
TABLE = """\
participant,trial,response,K1,B1,alpha
P01,1,close,5.2,6.1,0.2
P01,2,different,20.5,1.5,0.7
P02,1,similar,8.25,6.3,0.3
"""
IN_STUDIES = {  # what is wrong, and how the good file becomes so
    "a misspelt key": ("noise = 0.5", "nose = 0.5"),
    "missing keys": ('name = "memory foam"\n', ""),
    "a text where a number belongs": ("theta = 30.0", 'theta = "long"'),
    "a range upside down": ("low = 1.0\nhigh = 32.0", "low = 32.0\nhigh = 1.0"),
    "thresholds that do not rise": ("[-0.5, 0.5]", "[0.5, -0.5]"),
    "one threshold too few": ("[-0.5, 0.5]", "[0.0]"),
    "theta and length": ("theta = 30.0", "theta = 30.0\nlength = 0.13"),
    "another unit": ('unit = "N/mm"', 'unit = "N/m"'),
    "more space-filling trials than trials": ("[gp]", "[selection]\nspace_filling = 30\n[gp]"),
    "an unknown rule": ("[gp]", '[aggregation]\nrule = "mean"\n[gp]'),
}
IN_TABLES = {
    "a missing column": ("alpha", "order"),
    "an unknown response": ("similar", "near"),
    "a value out of the range": ("20.5", "205"),
    "a decimal comma in a table with commas": ("20.5", '"20,5"'),
    "a trial twice": ("P01,2", "P01,1"),
    "a trial that is not a number": ("P02,1", "P02,first"),
    "a row with a cell too few": (",0.3\n", "\n"),
    "a name where an id belongs": ("P02", "Jane Doe"),
    "a cell that a spreadsheet would run": ("P02", "=P02"),
}
CALLS = {
    "a theta below 0": "RBF(theta=-1.0)",
    "falling thresholds": "OrdinalProbit((0.5, -0.5), noise=0.5)",
    "x and q of different lengths": "Trials.from_arrays(x, q[:3])",
    "one point in place of several": "posterior.predict(x[0])",
    "points of another space": "posterior.predict(x[:, :1])",
    "the optimum without responses": "Session.start(study).best()",
    "an unknown response": 'Session.start(study).tell("near")',
}


def sentence(act: Callable[[], object]) -> str:
    """The error message of a mistake."""
    try:
        act()
    except InputError as error:
        return str(error)
    raise AssertionError("this is no mistake any more")


def mistakes() -> Iterator[tuple[str, str, str, str]]:
    """Section, mistake, input, error message."""
    for what, (good, bad) in IN_STUDIES.items():
        text = STUDY.replace(good, bad, 1)
        said = sentence(lambda text=text: checked(tomllib.loads(text), "study.toml", lambda file: file, text))
        yield "In a study file", what, bad or f"without {good}", said
    study = Study.from_dict(tomllib.loads(STUDY))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "trials.csv"
        for what, (good, bad) in IN_TABLES.items():
            path.write_text(TABLE.replace(good, bad, 1), encoding="utf-8")
            said = sentence(lambda: read_trials(path, study)).replace(f"{folder}/", "")
            yield "In a table", what, bad.strip() or f"without {good.strip()}", said
    names = _names()
    for what, call in CALLS.items():
        yield "In Python", what, call, sentence(lambda call=call: eval(call, names))


def _names() -> dict[str, object]:
    import numpy as np

    from hilbo import RBF, OrdinalGP, OrdinalProbit, Session, Trials, fit

    x, q = np.array([[0.2, 0.3], [0.5, 0.5], [0.9, 0.1], [0.4, 0.6]]), np.array([0, 2, 0, 1])
    posterior = fit(OrdinalGP(RBF(5.0), OrdinalProbit((-0.5, 0.5), 0.5)), Trials.from_arrays(x, q))
    parameters = {name: {"low": 0.0, "high": 1.0} for name in ("u", "v")}
    raw = {"schema": 1, "study": {"name": "plain", "responses": ["different", "similar", "close"]}}
    gp = {"theta": 5.0, "variance": 1.0, "thresholds": [-0.5, 0.5], "noise": 0.5}
    study = Study.from_dict(raw | {"parameters": parameters, "gp": gp})
    kinds = (RBF, OrdinalProbit, Session, Trials)
    return {"x": x, "q": q, "posterior": posterior, "study": study} | {kind.__name__: kind for kind in kinds}


def page() -> str:
    """The page as Markdown."""
    lines = [
        "# Common mistakes and their error messages",
        "",
        "Bad input gets one sentence: where, what, and what to do. A command ends with exit code 2 and writes nothing.",
        "This page is made by `python docs/site/mistakes.py`; a test compares it.",
    ]
    section = ""
    for here, what, written, said in mistakes():
        if here != section:
            section = here
            lines += ["", f"## {here}", "", "| mistake | input | error message |", "|---|---|---|"]
        cells = (what, f"`{' '.join(written.split())}`", said)
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
