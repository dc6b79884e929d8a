"""A whole study without a device, command by command: `python docs/site/first_study.py` runs it and writes the page."""

import tempfile
from pathlib import Path

from steps import Step, copied, section

PAGE = Path(__file__).parents[1] / "guides" / "first-study.md"
FIGURES = PAGE.parent / "first-study"

STEPS = (
    Step(
        """## A study file

Two parameters of a patch of colour, which a program of yours presents. `hilbo init` writes a commented file;
read it, and change what is asked. Hues are a circle, and hilbo has no parameter that is one: cut it where nobody
has to be asked.""",
        "hilbo init colour.toml --parameter hue=140:260:deg --parameter light=20:80:% --trials 20",
        files=("colour.toml",),
    ),
    Step(
        """`hilbo doctor` says what is missing. Here only the lines about the study; those about your machine come
before them.""",
        "hilbo doctor colour.toml",
        r"(ok|note|BAD) +(study|stimulus|participants' texts|protocol number)|  +->",
    ),
    Step(
        """## How many people, how many trials

Simulated studies of people as the study file states them: here two sizes and few studies, to be quick. Take
40 studies or more for your own.""",
        "hilbo power colour.toml --participants 4,8 --trials 10,20 --studies 6 --out power",
        figures=(("power/power.png", "Error of the optimum, share of studies within the error, error of the map."),),
    ),
    Step(
        """## Before the first answer

The plan, and the same as one page for a registry. What only you know stands there as a line to fill in.""",
        "hilbo plan colour.toml --participants 8 --register plan.md --out plan.json",
        files=("plan.md",),
    ),
    Step(
        """## Answers

Real ones come from `hilbo session` ([running a session](running-a-session.md)). Here eight simulated people answer,
so that the truth is known: the last line but one compares it with the optimum that was found.""",
        "hilbo simulate --study colour.toml --participants 8 --out simulated",
    ),
    Step(
        """## The population map

`hilbo simulate` did this already. Of real people's answers this command does it, from their table or the folder of
the sessions' logs. `--compare` tests every rule: it predicts each answer from other people's answers and from the
person's own earlier ones. The page is `results/report.html`; what was learnt of the model stands in
`results/result.json`, with intervals.""",
        "hilbo aggregate simulated/trials.csv --study colour.toml --compare --out results",
        figures=(
            (
                "results/map.png",
                "The population map: mean (colour, white lines), standard deviation (dotted), answers.",
            ),
            ("results/comparison.png", "Out-of-sample prediction by every rule, as differences to the best."),
        ),
    ),
    Step(
        """## The results section

A folder with the study file, the answers and the plan becomes one page with figures, tables, a checklist of
Bayesian reporting, and what departs from the plan. Of real sessions `hilbo export logs --study colour.toml --plan
plan.json --out study` makes this folder. Here three files are put together:

```
mkdir study
cp colour.toml study/study.toml
cp simulated/trials.csv plan.json study
```

Eight people are few: two halves of them need not agree on the optimum, and the dashed line of the first figure
says how far they are apart.""",
        "hilbo report study --out report",
        before=copied(
            {
                "colour.toml": "study/study.toml",
                "simulated/trials.csv": "study/trials.csv",
                "plan.json": "study/plan.json",
            }
        ),
        figures=(
            (
                "report/population-convergence.png",
                "Convergence: to the last place of the optimum, and between halves of the people.",
            ),
            ("report/classes.png", "The likeliest answer of a new participant, and tolerance intervals."),
        ),
    ),
)


def page() -> str:
    """The page as Markdown; runs everything, which takes minutes."""
    head = """# A first study, from beginning to end

Two visual parameters, no device, simulated answers: each command, what it says, and what it draws. The page
is made by `python docs/site/first_study.py`, which runs the commands. In your own study the answers come from
people; everything else stays."""
    FIGURES.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        return "\n\n".join([head, *(section(step, Path(folder), FIGURES) for step in STEPS)]) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
