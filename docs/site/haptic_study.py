"""The paper's study on three materials, command by command: `python docs/site/haptic_study.py` runs it on the simulated
device with simulated people, in about a quarter of an hour, and writes the page docs/guides/haptic-study.md.

`--check FOLDER` runs it there and leaves the page as it is: `--seed` takes other people, `--other` other materials,
`--mishaps` has one participant drop out, one guess and one with a voided trial, `--small` two people for each material.
"""

import argparse
import json
import re
import sys
import tempfile
import tomllib
from functools import partial
from pathlib import Path
from typing import NamedTuple

from haptic_people import PROTOCOL, Lab, balance, take_part
from steps import Step, copied, section

__all__ = ["FIGURES", "FULL", "LAB", "PAGE", "SMALL", "Size", "steps"]

PAGE = Path(__file__).parents[1] / "guides" / "haptic-study.md"
FIGURES = PAGE.parent / "haptic-study"

MATERIALS = ("foam", "medium", "stiff")
LAB = Lab({"foam": (-2.89, 5.7, 5.89, 0.203), "medium": (-2.97, 6.0, 8.0, 0.15), "stiff": (-1.32, 5.0, 4.0, 0.15)})
OTHER = Lab({"foam": (-2.0, 4.5, 5.0, 0.25), "medium": (-1.717, 5.0, 4.0, 0.15), "stiff": (-1.5, 4.0, 6.0, 0.2)})


class Size(NamedTuple):
    """Numbers of the study: participants of each material, of the pilot, of the validation of the foam's map and of
    aggregate-best; trials of an optimisation; repeats of the material tests and how long each is held, s; studies of
    `hilbo power`, and their numbers of participants."""

    people: tuple[int, int, int] = (24, 8, 8)
    pilot: int = 8
    newcomers: int = 20
    judges: int = 8
    trials: int = 25
    repeats: int = 16
    hold: int = 3
    studies: int = 10
    counts: str = "8,24"


FULL = Size()
SMALL = Size((2, 2, 2), 3, 2, 2, 8, 2, 1, 2, "2,3")

HEAD = """# A haptic study on three materials, from the unpacked device to the results

The study of the paper: optimisation of the viscoelastic model for a foam and two silicones, validation of the maps, and
the population's best against everybody's own. Each command, what it says, and what it draws. The page is made by
`python docs/site/haptic_study.py`, which runs all of it on the simulated device, with simulated people; nothing is
edited by hand. The lab's side of a session has [a checklist](running-a-session.md)."""


def names(letter: str, count: int) -> str:
    """Ids of participants, separated by commas."""
    return ",".join(f"{letter}{i:02d}" for i in range(1, count + 1))


def write_study(size: Size, folder: Path) -> None:
    """Write haptic.toml with the measured damping and the identified stiffness of each material."""
    measured = (folder / "damping.txt").read_text(encoding="utf-8")
    blocks = {m: (folder / m / "renderer.toml").read_text(encoding="utf-8") for m in MATERIALS}
    numbers = {m: re.search(r"^K_eff = (\S+)", block, re.M)[1] for m, block in blocks.items()}
    numbers["damping"] = re.search(r"plan studies with at most (\S+)\.", measured)[1]
    shared = {"trials": size.trials, "least": min(10, size.trials), "people": size.people, "protocol": PROTOCOL}
    text = Path(__file__).with_name("haptic.toml").read_text(encoding="utf-8")
    (folder / "haptic.toml").write_text(text.format(**numbers, **shared), encoding="utf-8")


def look_at_pilot(folder: Path) -> None:
    """Say on stderr if an interval of the pilot does not hold the study file's value, as the page says they all do."""
    given = tomllib.loads((folder / "haptic.toml").read_text(encoding="utf-8"))["gp"]
    pilot = json.loads((folder / "pilot" / "result.json").read_text(encoding="utf-8"))["pilot"]["intervals"]
    for name, intervals in pilot.items():
        values = given[name] if isinstance(given[name], list) else [given[name]]
        for value, (low, high) in zip(values, intervals, strict=True):
            if not low <= value <= high:
                print(f"{name} = {value} is not within {low:.3g} to {high:.3g}: correct the page", file=sys.stderr)


def sessions(lab: Lab, plan: str, folder: Path) -> str:
    """The sessions of a plan of comparisons, and its balance."""
    return "\n".join([take_part(lab, folder, plan), balance(folder, plan)])


def device_steps() -> list[Step]:
    """The unpacked device."""
    return [
        Step(
            """## The device

On the day it is unpacked: sign of encoder and motor with little energy, homing, delay and damping. `commission` asks
whether no hand is on the handle, and writes the header with which the firmware is built again. All commands below talk
to the simulated device; with yours they need `--device PORT`.""",
            "hilbo device commission --out hilbo_device_config.h",
            answers=("--no-hand-on-the-handle", "no hand is on the handle", "--encoder-checked"),
        ),
        Step(
            "The damping of the free device, again on every morning. Its interval's lower end counts for passivity.",
            "hilbo device measure-damping > damping.txt",
            files=("damping.txt",),
        ),
        Step("The line, and the delay from a position to its force.", "hilbo device selftest"),
    ]


def material_steps(size: Size, lab: Lab, material: str) -> list[Step]:
    """Tests of one material, and its identification."""
    numbers = ",".join(f"{value:g}" for value in lab.materials[material])
    head = """## The materials

The device presses each material: relaxation and creep, every test repeated. `--sim material=…` is what the *simulated*
device is pressed against; leave it out with yours. `hilbo identify` fits the model, and writes the block `[renderer]`
and a row for the table of sets, with 95 % intervals."""
    tests = f"hilbo device characterise {material}.csv --repeats {size.repeats} --hold {size.hold}"
    fitted = f"Relaxation and creep of the {material}, and the fitted model."
    return [
        Step(head if material == MATERIALS[0] else "", f"{tests} --sim material={numbers},101"),
        Step(
            "",
            f"hilbo identify {material}.csv --material {material} --damping 0.947 --out {material}",
            r"hilbo:|.*report\.html",
            figures=((f"{material}/tests.png", fitted),) if material == MATERIALS[0] else (),
            files=(f"{material}/renderer.toml",),
        ),
    ]


def pilot_steps(size: Size, lab: Lab) -> list[Step]:
    """The study file, and the hyperparameters from a pilot."""
    return [
        Step(
            """## The study file

The numbers of `[renderer]` and `[materials]` are those of the damping and of the three `renderer.toml`. Ranges, steps
and texts are the paper's. `[plan] people` says how many participants each material has.""",
            before=partial(write_study, size),
            files=("haptic.toml",),
        ),
        Step("", "hilbo doctor haptic.toml", r"(ok|note|BAD) +(study|feasible set|protocol number|damping)|  +->"),
        Step(
            f"""## A pilot

`rule = "bcm"`, the paper's and the default, needs hyperparameters that are stated before the first answer; the study
file has the paper's. Do the answers of {size.pilot} people who are not in the study contradict them?""",
            f"hilbo plan haptic.toml --names {names('T', size.pilot)} --material foam --out pilot.json",
        ),
        Step(
            """A session each, with a link for the tablet and one for the laptop:

```
hilbo session haptic.toml --plan pilot.json --participant T01 --logs pilot-logs --device PORT --lan
```

On this page simulated people answer:""",
            instead=partial(take_part, lab, plan="pilot.json", logs="pilot-logs"),
        ),
        Step(
            """The printed table could take the place of `[gp]`. Its intervals hold the paper's values, which stay. In
simulated studies [a pilot's values gained nothing](../methods/aggregation.md#robustness-to-the-hyperparameters).
The [recommended rule](../methods/which_method.md) learns them from the study itself, and needs no pilot.""",
            "hilbo robustness pilot-logs --study haptic.toml --material foam --pilot --out pilot > gp.toml",
            r"hilbo:",
            files=("gp.toml",),
        ),
    ]


def optimisation_steps(size: Size, lab: Lab) -> list[Step]:
    """Power, the plan, and everybody's optimisation."""
    made = [
        Step(
            """## How many people

Simulated studies of the foam with fewer and with more people: few studies here, to be quick. Take 40 or more for your
own.""",
            f"hilbo power haptic.toml --material foam --participants {size.counts} --trials {size.trials}"
            f" --studies {size.studies} --out power",
            r"power/",
            before=look_at_pilot,
            figures=(("power/power.png", "Error of the optimum, share of studies within it, error of the map."),),
        ),
        Step(
            """## The plan

Which participant has which material is drawn at random, in permuted blocks. `plan.md` is the page for a registry.""",
            "hilbo plan haptic.toml --register plan.md --out plan.json",
        ),
        Step(
            """## The optimisations

Consent, then the session:

```
hilbo participants add logs/participants.csv P01 --consent-time 2026-03-02T10:00 --protocol-number 2026-07 --age 24
hilbo session haptic.toml --plan plan.json --participant P01 --logs logs --device PORT --lan
```""",
            instead=partial(take_part, lab, plan="plan.json"),
        ),
    ]
    if lab.drops_out:
        made += [
            Step("", f"hilbo plan haptic.toml --reissue {lab.drops_out}=P99 --out plan.json --force"),
            Step("", instead=partial(take_part, lab, plan="plan.json", only="P99")),
        ]
    return made


def map_steps() -> list[Step]:
    """The maps, by the study's rule and by the recommended one, and their robustness."""
    made = [
        Step(
            "## The maps\n\nOne for each material." if material == MATERIALS[0] else "",
            f"hilbo aggregate logs --study haptic.toml --material {material} --out results/{material}",
            r"The population optimum|hilbo:",
            figures=((f"results/{material}/map.png", f"Map of the {material}: mean, standard deviation, answers."),),
        )
        for material in MATERIALS
    ]
    learnt = Step(
        "The recommended rule, on the same answers of the foam:",
        "hilbo aggregate logs --study haptic.toml --material foam --rule learnt-2 --out results/foam-learnt",
        r"The population optimum|hilbo:",
    )
    robust = Step(
        """Does the optimum depend on the hyperparameters? Those of the study file are compared with those for which the
answers have the largest evidence.""",
        "hilbo robustness logs --study haptic.toml --material foam --out robustness",
        r"hilbo:|robustness/",
        figures=(("robustness/maps.png", "The foam's map under both."),),
    )
    return [*made, learnt, robust]


def validation_steps(size: Size, lab: Lab) -> list[Step]:
    """Validation by new people, by one's own maps, and the population's best against everybody's."""
    results = {material: f"--from {material}=results/{material}/result.json" for material in MATERIALS}
    return [
        Step(
            """## Validation of the foam's map

People who are not in the map compare its best, mid and worst set.""",
            f"hilbo plan haptic.toml --kind validation --names {names('N', size.newcomers)} --material foam"
            f" {results['foam']} --trials logs --session validation --out validation.json",
        ),
        Step("Their sessions, and the balance of the plan:", instead=partial(sessions, lab, "validation.json")),
        Step(
            """## Validation of the silicones by one's own map

Everybody with a map of a silicone compares best, mid and worst of that map. Where a map has no minimum that is known
well enough, the plan takes the set of second choice and says whose.""",
            f"hilbo plan haptic.toml --kind validation --source individual --material medium --material stiff"
            f" {results['medium']} {results['stiff']} --trials logs --session own --out own.json",
        ),
        Step("", instead=partial(sessions, lab, "own.json")),
        Step(
            """## The population's best against everybody's

Other people compare the population's best set with each individual's best one, of all three materials in one session:
one warm-up, a rest of 10 min between materials, foam pairs twice and silicone pairs three times.""",
            f"hilbo plan haptic.toml --kind aggregate-best --names {names('A', size.judges)}"
            f" {' '.join(results.values())} --trials logs --session best --out best.json",
        ),
        Step("", instead=partial(sessions, lab, "best.json")),
    ]


def result_steps() -> list[Step]:
    """Export and report."""
    plans = " ".join(f"--plan {name}.json" for name in ("plan", "validation", "own", "best"))
    classes = [(f"report/{m}/classes.png", f"The likeliest answer, and tolerance intervals: {m}.") for m in MATERIALS]
    return [
        Step(
            """## The results section

Tables of all sessions, with the plans, so that the report can say what departs from them.""",
            f"hilbo export logs --study haptic.toml {plans} --out tables",
        ),
        Step(
            """The identified sets are the reference of the errors:

```
for material in foam medium stiff; do cp $material/sets.csv tables/sets-$material.csv; done
```""",
            "hilbo report tables --people logs/participants.csv --out report",
            r"hilbo:|report/",
            before=copied({f"{material}/sets.csv": f"tables/sets-{material}.csv" for material in MATERIALS}),
            figures=(
                ("report/foam/population-convergence.png", "Foam: convergence of the population optimum."),
                ("report/foam/validation.png", "Foam: best, mid and worst in the validation."),
                ("report/foam/aggregate-best.png", "Foam: the population's best against everybody's."),
                *classes,
            ),
        ),
    ]


def steps(size: Size, lab: Lab) -> list[Step]:
    """All steps of the page."""
    materials = [step for material in MATERIALS for step in material_steps(size, lab, material)]
    made = [*device_steps(), *materials, *pilot_steps(size, lab), *optimisation_steps(size, lab), *map_steps()]
    return [*made, *validation_steps(size, lab), *result_steps()]


def page(size: Size, lab: Lab, folder: Path, figures: Path) -> str:
    """The page as Markdown; runs everything in `folder`."""
    figures.mkdir(exist_ok=True)
    return "\n\n".join([HEAD, *(section(step, folder, figures) for step in steps(size, lab))]) + "\n"


def main() -> None:
    """Run the study; write the page, unless `--check` is given."""
    given = argparse.ArgumentParser(description=__doc__)
    given.add_argument("--check", type=Path, help="a new folder; the page stays as it is")
    given.add_argument("--seed", type=int, default=0, help="of the people")
    for name in ("small", "other", "mishaps"):
        given.add_argument(f"--{name}", action="store_true")
    asked = given.parse_args()
    lab = (OTHER if asked.other else LAB)._replace(seed=asked.seed)
    lab = lab._replace(drops_out="P02", guesses="P03", voids="P04") if asked.mishaps else lab
    size = SMALL if asked.small else FULL
    if asked.check is not None:
        asked.check.mkdir(parents=True)
        (asked.check / "page.md").write_text(page(size, lab, asked.check, asked.check / "figures"), encoding="utf-8")
        return
    with tempfile.TemporaryDirectory() as folder:
        PAGE.write_text(page(size, lab, Path(folder), FIGURES), encoding="utf-8")


if __name__ == "__main__":
    main()
