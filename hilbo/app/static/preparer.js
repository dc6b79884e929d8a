// The preparer's page: what to present next, as a label and a setting, and what became of it. The server decides.
//
// The page gives signs of life and is told the newest order by the same messages as a program that presents
// (docs/guides/stimulus.md). Nothing is confirmed but by a button.
"use strict";
if (refusal) throw new Error(refusal);

const at = (id) => document.getElementById(id);
const put = (id, text) => { if (at(id).textContent !== text) at(id).textContent = text; };
const show = (id, yes) => { at(id).hidden = !yes; };
const server = requests(keyOf("preparer"));
const SETTLES = 300;                 // ms: a tap that comes sooner was for what stood there before

let run = null, silence = 10, units = {}, tolerances = {}, levels = {};
let order = { order: 0, do: "neutral" }, done = "neutral";   // the newest order, and what was done about it
let since = 0, heard = 0, alerted = "", over = "";           // when it came, when the server was heard (performance.now())
let presentedBefore = false;         // something stands there that is to be taken away
let asking = false;                  // the reason is being entered

async function post(path, content) {
  const reply = await server.ask(path, content, 1000 * silence);
  return [reply.status, await reply.json()];
}

async function ready() {
  const said = { name: "preparer's page", version: "1", force: false, neutral_within_s: 10 };
  try {
    const [status, found] = await post("/api/preparer/hello", said);
    if (status !== 200) { refuse(status, found); return; }
    run = found.run; silence = found.silence_s; presentedBefore = false; alerted = "";
    for (const p of found.parameters) {
      units[p.name] = p.unit; levels[p.name] = p.levels || null;
      tolerances[p.name] = (value) => p.share ? p.share * value : p.tolerance;
    }
    put("what", found.study);
    take(found);
    await report("neutral");         // Ready reports that nothing is presented
    listen(run);
  } catch { lost("The server does not answer."); }
}

// As few digits after the point as round a value by half of its tolerance at most.
function rounded(value, off) {
  return String(off > 0 ? Number(value.toFixed(Math.min(100, Math.max(0, Math.ceil(-Math.log10(off)))))) : value);
}

// Signs of life, and the newest order, as long as this run goes on.
async function listen(mine) {
  while (run === mine) {
    try { await report(done, { wait_s: silence / 3 }, false); } catch { lost("The connection to the server is gone."); }
  }
}

// `settles`: the report of a button that was pressed.
async function report(state, more = {}, settles = true) {
  const about = order, trial = state === "presented" ? { trial: about.trial } : {};
  const [status, found] = await post("/api/preparer", { run, order: about.order, state, ...trial, ...more });
  if (status === 200 && settles && about === order && state !== "failed") done = state;
  if (status !== 200) refuse(status, found);
  if ("order" in found) take(found);
  return status === 200;
}

function take(found) {
  heard = performance.now();
  if (found.order > order.order || found.run) {
    if (order.do === "present" && done === "presented") presentedBefore = true;
    order = found; since = performance.now(); asking = false; alerted = "";
    done = found.do === "present" || presentedBefore || found.do === "stop" ? "busy" : "neutral";
    layOut();
  }
  draw();
}

function refuse(status, found) {
  if (status === 401 || status === 403) { over = found.error; run = null; }
  else if (!("order" in found)) lost(found.error);
  else alerted = found.error;
  draw();
}

function lost(why) { if (run === null && alerted) return; run = null; alerted = why; draw(); }

function layOut() {
  const box = at("setting"), values = order.values || {};
  box.replaceChildren(...Object.keys(values).flatMap((name, i) => {
    const choice = levels[name];
    const input = choice
      ? Object.assign(document.createElement("select"), { id: `value-${i}` })
      : Object.assign(document.createElement("input"), { id: `value-${i}`, inputMode: "decimal", autocomplete: "off" });
    if (choice) input.replaceChildren(...choice.map((level) => new Option(level, level)));
    input.value = typeof values[name] === "number" ? rounded(values[name], tolerances[name] ? tolerances[name](values[name]) : 0) : String(values[name]);
    input.dataset.name = name;
    input.dataset.number = typeof values[name] === "number" ? "yes" : "";
    return [
      Object.assign(document.createElement("label"), { textContent: name, htmlFor: input.id }), input,
      Object.assign(document.createElement("span"), { textContent: units[name] || "", className: "soft" }),
    ];
  }));
}

// What is really in force: what stands in the fields. null where one is no number.
function values() {
  const found = {};
  for (const input of at("setting").querySelectorAll("input, select")) {
    const text = input.value.trim().replace(",", "."), number = Number(text);
    if (input.dataset.number && (text === "" || !Number.isFinite(number))) return null;
    found[input.dataset.name] = input.dataset.number ? number : input.value.trim();
  }
  return found;
}

function phase() {
  if (over) return "over";
  if (run === null) return "ready";
  if (order.do === "present") return done === "presented" ? "shown" : "present";
  return order.do === "stop" ? "stop" : done === "neutral" ? "wait" : "away";
}

const WORDS = {
  over: ["This page is no longer part of the session", "", ""],
  ready: ["Are you there, and is nothing presented?", "The stimuli to present are shown here, one after the other. Leave this page open, and do not show it to others.", "Ready"],
  present: ["", "Present this, correct the values here if the presented ones differ, then press.", "Presented"],
  shown: ["It is presented", "Do not change it.", ""],
  away: ["Take it away", "The participant is responding.", "Taken away"],
  wait: ["Nothing to present now", "The next stimulus will be shown here.", ""],
  stop: ["Stop: take everything away at once", "Then press.", "Nothing is presented"],
};

function draw() {
  const now = phase(), [title, message, button] = WORDS[now], label = order.label || "";
  const presents = now === "present" || now === "shown";
  document.body.dataset.phase = now;
  put("title", presents && now === "present" ? (order.show === "reference" ? "Present the reference" : "Present") : title);
  put("message", over || (now === "present" && order.show === "reference" ? "Then press." : message));
  put("label", label); show("label", presents && !!label);
  show("setting", presents && order.show === "test");
  for (const input of at("setting").querySelectorAll("input, select")) input.disabled = now !== "present";
  show("go", !!button); put("go", button);
  show("could-not", now === "present" && !asking);
  show("why", now === "present" && asking);
  show("alert", !!alerted); put("alert", alerted);
}

async function go() {
  const now = phase();
  if (performance.now() - since < SETTLES && now !== "ready") return;
  try {
    if (now === "ready") await ready();
    else if (now === "present") {
      const found = values();
      if (!found) { alerted = "A value is no number; write it with digits and a point."; draw(); return; }
      await report("presented", Object.keys(found).length ? { values: found } : {});
    } else { await report("neutral"); presentedBefore = false; }
  } catch { lost("The connection to the server is gone."); }
  draw();
}

function tick() {
  const left = order.within_s - (performance.now() - since) / 1000;
  put("left", phase() === "present" ? `${Math.max(0, Math.ceil(left))} s left` : "");
  if (run !== null && performance.now() - heard > 1000 * silence) lost("The server is silent. Take away what is presented.");
  setTimeout(tick, 250);
}

at("go").addEventListener("click", go);
at("could-not").addEventListener("click", () => { asking = true; draw(); at("why-text").focus(); });
at("why").addEventListener("submit", async (e) => {
  e.preventDefault();
  const why = at("why-text").value.trim();
  at("why-text").value = "";
  try { await report("failed", { why: why || "the preparer could not" }); asking = false; } catch { lost("The connection to the server is gone."); }
  draw();
});
draw();
tick();
