"""Write psychopy.csv with PsychoPy's own ExperimentHandler, from the clean table.

pip install --no-deps psychopy && pip install numpy pandas json_tricks i18next
python tests/support/export_samples/write_psychopy.py CLEAN.csv
"""

import csv
import sys
import tempfile
from pathlib import Path

from psychopy import data

LABELS = ["different", "similar", "close"]
rows = list(csv.DictReader(Path(sys.argv[1]).read_text(encoding="utf-8").splitlines()))
out = Path(__file__).with_name("psychopy.csv")
lines: list[list[str]] = []
for person in dict.fromkeys(row["participant"] for row in rows):
    info = {"participant": person, "session": "001", "date": "2026-05-04_10h12.33.104", "psychopyVersion": "2026.2.5"}
    handler = data.ExperimentHandler(name="colour", version="", extraInfo=info, savePickle=False, saveWideText=False)
    handler.addData("thisRow.t", 0.0)
    handler.nextEntry()
    theirs = [row for row in rows if row["participant"] == person]
    conditions = [{"hue": float(row["hue"]), "light": float(row["light"])} for row in theirs]
    trials = data.TrialHandler2(name="trials", nReps=1, method="sequential", extraInfo=info, trialList=conditions)
    handler.addLoop(trials)
    for row, _ in zip(theirs, trials, strict=True):
        trials.addData("slider.response", LABELS.index(row["response"]) + 1)
        trials.addData("slider.rt", 0.812)
        handler.nextEntry()
    handler.addData("thanks.started", 61.2)
    handler.nextEntry()
    file = Path(tempfile.mkdtemp(), f"{person}.csv")
    handler.saveAsWideText(str(file), delim=",")
    text = list(csv.reader(file.read_text(encoding="utf-8-sig").splitlines()))
    lines += text if not lines else text[1:]
with out.open("w", newline="", encoding="utf-8") as table:
    csv.writer(table).writerows(lines)
