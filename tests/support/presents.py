"""A program that presents, to be killed: `python presents.py LINK KEY_FILE`. It rounds the hue to whole degrees."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "clients"))

from hilbo_stimulus import Stimulus


def main(link, key_file):
    with Stimulus(link, name="presents.py", version="1", key_file=key_file) as stimulus:
        for order in stimulus:
            if order.do == "present":
                values = {**order.values, "hue": float(round(order.values["hue"]))} if order.values else None
                stimulus.presented(values)
            else:
                stimulus.neutral()


if __name__ == "__main__":
    main(*sys.argv[1:])
