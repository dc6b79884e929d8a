"""The README's picture, from the demo's simulated study: `python docs/site/readme_picture.py demo-results`, after
`make demo`, writes docs/population-map.png, and docs/population-map.json with the numbers that it is drawn from.
`--computed` prints these numbers, computed again from the simulated study, as JSON.
"""

import json
import sys
import tempfile
from pathlib import Path

import pandas as pd

__all__ = ["NUMBERS", "computed", "numbers"]

DOCS = Path(__file__).parents[1]
NUMBERS = DOCS / "population-map.json"
PART = "simulated-memory-foam"


def numbers(folder: Path) -> dict:
    """Seed and number of participants of a report's folder, and the parameters of the population optimum and of the
    best, mid and worst sets."""
    content = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    (material,) = content["materials"].values()
    table = pd.read_csv(folder / "alternatives.csv").set_index("optimum")
    parameters = list(material["optimum"]["parameters"])
    sets = {name: {p: float(table.at[name, p]) for p in parameters} for name in ("population", "best", "mid", "worst")}
    return {"seed": content["seed"], "participants": len(material["participants"])} | sets


def computed(participants: int, seed: int) -> dict:
    """The same numbers of the demo's simulated study, computed without its report."""
    from hilbo import Study, read_trials
    from hilbo.search.candidates import search_points
    from hilbo.search.rendering import Rendering
    from hilbo.simulation.folder import simulate_folder
    from hilbo.study.analysis.best_mid_worst import best_mid_worst
    from hilbo.study.cohort import cohort_of
    from hilbo.study.estimate.aggregate import aggregate_cohort

    with tempfile.TemporaryDirectory() as folder:
        simulate_folder(Path(folder), "paper", participants, seed)
        study = Study.load(Path(folder) / "study.toml")
        cohort = cohort_of(read_trials(Path(folder) / "trials.csv", study), study)
    aggregate = aggregate_cohort(study, cohort, seed, alternatives=False, individuals=False)
    points = search_points(study.space, seed)
    sets = best_mid_worst(study, aggregate.surface, points, prior=aggregate.map.map_prior)
    places = zip(("population", "best", "mid", "worst"), [aggregate.optimum.x, *sets.x], strict=True)
    shown = {name: Rendering.at(study.space, x).shown for name, x in places}
    return {"seed": seed, "participants": participants} | shown


def main() -> None:
    from PIL import Image

    if sys.argv[1] == "--computed":
        import jax

        jax.config.update("jax_enable_x64", True)
        known = json.loads(NUMBERS.read_text(encoding="utf-8"))
        print(json.dumps(computed(known["participants"], known["seed"])))
        return
    folder = Path(sys.argv[1]) / PART
    picture = Image.open(folder / "map.png").convert("RGB")
    picture.quantize(256, dither=Image.Dither.NONE).save(DOCS / "population-map.png", optimize=True)
    NUMBERS.write_text(json.dumps(numbers(folder), indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
