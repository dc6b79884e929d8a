"""Withdrawals together with other commands, each killed at a random change of the disk and given again.

    python attacks/withdrawal_kills.py --count 10000 --seed 0 --state withdrawal_kills.json

Two to four commands (withdrawals, additions to the list, exports, new study files) come at once in a small study; at
each change of the disk a random one goes on. When all are done, whoever withdrew is in no byte of any file, nobody else
is missing, and every file is whole.
"""

import random
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[1] / "tests" / "support")]

from withdrawn_study import Schedule, make_study, older_log

from attacks.support import main, scratch

__all__ = ["schedule_case"]


def schedule_case() -> Callable[[random.Random, int], str]:
    """The attack's case."""
    folder = scratch("withdrawal-kills")
    (folder / "logs").mkdir()
    (folder / "whole").mkdir()
    make_study(folder / "whole", [older_log(folder / "logs", name, "sysid") for name in ("P01", "P02", "P04")])

    def case(rng: random.Random, number: int) -> str:
        shutil.copytree(folder / "whole", folder / "copy")
        try:
            wrong = Schedule(folder / "copy", rng).run()
        finally:
            shutil.rmtree(folder / "copy")
        return f"THROUGH: {'; '.join(wrong)}" if wrong else "all is done"

    return case


if __name__ == "__main__":
    main(schedule_case, __doc__ or "", 10_000)
