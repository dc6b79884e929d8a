"""The README's picture, from the demo's simulated study: `python docs/site/readme_picture.py demo-results`, after
`make demo`, writes docs/population-map.png, and docs/population-map.json with the numbers that it is drawn from.
"""

import json
import sys
from pathlib import Path

import pandas as pd

__all__ = ["NUMBERS", "numbers"]

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


def main() -> None:
    from PIL import Image

    folder = Path(sys.argv[1]) / PART
    picture = Image.open(folder / "map.png").convert("RGB")
    picture.quantize(256, dither=Image.Dither.NONE).save(DOCS / "population-map.png", optimize=True)
    NUMBERS.write_text(json.dumps(numbers(folder), indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
