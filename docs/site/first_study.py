"""A whole study without a device, command by command: `python docs/site/first_study.py` runs it and writes the page."""

import tempfile
from pathlib import Path

from steps import Step, copied, section

PAGE = Path(__file__).parents[1] / "guides" / "first-study.md"
FIGURES = PAGE.parent / "first-study"

STEPS = (
    Step(
        """## A study file

Two parameters of a patch of colour, presented by your own program. `hilbo init` writes a commented file; read and
edit it. Hue is circular, and hilbo has no circular parameters: cut the circle at a value that need not be tested.""",
        "hilbo init colour.toml --parameter hue=140:260:deg --parameter light=20:80:% --trials 20",
        files=("colour.toml",),
    ),
    Step(
        """`hilbo doctor` lists the missing items. Only the lines about the study are shown; those about your machine
precede them.""",
        "hilbo doctor colour.toml",
        r"(ok|note|BAD) +(study|stimulus|participants' texts|protocol number)|  +->",
    ),
    Step(
        """## How many people, how many trials

Simulated studies with the participants that the study file specifies: here two sizes and few studies, to be quick.
Use 40 studies or more for your own.""",
        "hilbo power colour.toml --participants 4,8 --trials 10,20 --studies 6 --out power",
        figures=(("power/power.png", "Error of the optimum, share of studies within the error, error of the map."),),
    ),
    Step(
        """## Before the first response

The plan, and a page for preregistration, with blank items to complete.""",
        "hilbo plan colour.toml --participants 8 --register plan.md --out plan.json",
        files=("plan.md",),
    ),
    Step(
        """## Responses

Real ones come from `hilbo session` ([running a session](running-a-session.md)). Here eight participants are simulated,
so that the truth is known: the last line but one compares it with the estimated optimum.""",
        "hilbo simulate --study colour.toml --participants 8 --out simulated",
    ),
    Step(
        """## The population map

`hilbo simulate` has done this already. For real responses use this command with their table or the folder of
the session logs. `--compare` tests all methods by cross-validation: each response is predicted from the other
participants' responses and from the participant's earlier ones. The page is `results/report.html`; the fitted
hyperparameters are in `results/result.json`, with intervals.""",
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

A folder with the study file, the responses and the plan becomes one page with figures, tables, a checklist of
Bayesian reporting, and the deviations from the plan. For real sessions `hilbo export logs --study colour.toml --plan
plan.json --out study` makes this folder. Here three files are copied:

```
mkdir study
cp colour.toml study/study.toml
cp simulated/trials.csv plan.json study
```

Eight participants are few: two halves of them need not agree on the optimum; the dashed line of the first figure
shows their distance.""",
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
                "Convergence: to the last place of the optimum, and between split halves.",
            ),
            ("report/classes.png", "Most probable response of a new participant, and tolerance intervals."),
        ),
    ),
)


def page() -> str:
    """The page as Markdown; runs everything, which takes minutes."""
    head = """# A first study, from beginning to end

Two visual parameters, no device, simulated responses: each command with its output and figures. The page
is made by `python docs/site/first_study.py`, which runs the commands. In your own study the responses come from
participants; everything else is the same."""
    FIGURES.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        return "\n\n".join([head, *(section(step, Path(folder), FIGURES) for step in STEPS)]) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
