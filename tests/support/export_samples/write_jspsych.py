"""Write jspsych.csv and jspsych.json with jsPsych itself, in a browser, from the clean table.

npm install jspsych @jspsych/plugin-html-button-response @jspsych/plugin-survey-likert
pip install playwright
python tests/support/export_samples/write_jspsych.py CLEAN.csv NODE_MODULES
"""

import csv
import json
import sys
from pathlib import Path

from playwright.sync_api import sync_playwright

rows = list(csv.DictReader(Path(sys.argv[1]).read_text(encoding="utf-8").splitlines()))
modules = Path(sys.argv[2])
packages = ("jspsych", "@jspsych/plugin-html-button-response", "@jspsych/plugin-survey-likert")
scripts = [(modules / package / "dist" / "index.browser.js").read_text() for package in packages]
RUN = """
async ([rows, likert]) => {
  const labels = ["different", "similar", "close"];
  const jsPsych = initJsPsych();
  jsPsych.data.addProperties({subject: rows[0].participant});
  const choice = row => ({
    type: jsPsychHtmlButtonResponse, stimulus: "<p>rate</p>", choices: labels,
    data: {hue: Number(row.hue), light: Number(row.light)},
  });
  const scale = row => ({
    type: jsPsychSurveyLikert, questions: [{prompt: "rate", labels: labels, required: true}],
    data: {hue: Number(row.hue), light: Number(row.light)},
  });
  const begin = {type: jsPsychHtmlButtonResponse, stimulus: "welcome", choices: ["begin"]};
  const timeline = [begin, ...rows.map(likert ? scale : choice)];
  const wanted = [0, ...rows.map(row => labels.indexOf(row.response))];
  let trial = 0;
  const press = setInterval(() => {
    const buttons = document.querySelectorAll("#jspsych-html-button-response-btngroup button:not([disabled])");
    const radios = document.querySelectorAll("input[type=radio]");
    if (buttons.length) { buttons[wanted[trial++]].click(); }
    else if (radios.length) { radios[wanted[trial++]].click(); document.querySelector("input[type=submit]").click(); }
  }, 30);
  await jsPsych.run(timeline);
  clearInterval(press);
  return [jsPsych.data.get().csv(), jsPsych.data.get().json()];
}
"""
texts: list[str] = []
records: list[str] = []
with sync_playwright() as play:
    browser = play.chromium.launch(executable_path="/usr/bin/chromium", args=["--no-sandbox"])
    for person in dict.fromkeys(row["participant"] for row in rows):
        theirs = [row for row in rows if row["participant"] == person]
        for likert in (False, True):
            page = browser.new_page()
            page.set_content("<html><body></body></html>")
            for script in scripts:
                page.add_script_tag(content=script)
            text, record = page.evaluate(RUN, [theirs, likert])
            page.close()
            if likert:
                records.append(json.dumps(json.loads(record)))
            else:
                texts.append(text)
    browser.close()
here = Path(__file__).parent
head = texts[0].splitlines()[0]
lines = [line for text in texts for line in text.splitlines()[1:]]
(here / "jspsych.csv").write_text("\n".join([head, *lines]) + "\n", encoding="utf-8")
(here / "jspsych.json").write_text("\n".join(records) + "\n", encoding="utf-8")
