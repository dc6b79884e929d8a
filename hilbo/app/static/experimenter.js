// The experimenter's page: everything the server knows, and the commands. Nothing is decided here.
"use strict";
if (refusal) throw new Error(refusal);

const at = (id) => document.getElementById(id);
const put = (id, text) => { if (at(id).textContent !== text) at(id).textContent = text; };
const server = requests(keyOf("experimenter"));
const SAID = 10000;                  // ms that a refusal stays on the page
let view = null, mapOf = null, map = null, lastEscape = 0;
let said = { text: "", until: 0 };   // the page's own message, in addition to the server's alert

function number(value, digits = 4) {
  if (value === null || value === undefined) return "–";
  return typeof value === "number" ? String(Number(value.toPrecision(digits))) : String(value);
}

function list(id, rows) {
  const marks = rows.map(([name, text]) => `${name}\u0000${text}`);
  if (at(id).dataset.shown === marks.join("\n")) return;
  at(id).dataset.shown = marks.join("\n");
  at(id).replaceChildren(...rows.flatMap(([name, text]) => [
    Object.assign(document.createElement("dt"), { textContent: name }),
    Object.assign(document.createElement("dd"), { textContent: text }),
  ]));
}

function draw() {
  if (!view) return;
  put("who", view.who); put("what", view.what); put("phase", view.phase_words);
  document.title = `${view.who} – ${view.phase_words}`;
  document.body.dataset.phase = view.phase;
  list("trial", view.trial); list("trust", view.trust);
  at("trust-box").hidden = !view.trust.length;
  at("answers-box").hidden = !view.table.rows.length;
  at("log-box").hidden = !view.log.length;
  drawBanners(); drawDevice(); drawAlert(); drawAnswers(); drawLog();
  put("watch", view.participant_here ? "The participant's page is connected." : "The participant's page is not connected.");
  for (const b of document.querySelectorAll("[data-command]")) b.disabled = !view.may.includes(b.dataset.command);
  at("skip").hidden = !view.may.includes("skip");
  for (const b of document.querySelectorAll(".stop")) b.disabled = !view.may.includes("estop");
  if (view.map_version !== mapOf) { mapOf = view.map_version; loadMap(); }
}

function drawBanners() {
  const mark = view.banners.join("\n");
  if (at("banners").dataset.shown === mark) return;
  at("banners").dataset.shown = mark;
  at("banners").replaceChildren(...view.banners.map((text) => Object.assign(document.createElement("li"), { textContent: text })));
}

function drawDevice() {
  const d = view.device;
  put("device-name", d.title); 
  const presents = d.title !== "Device";
  at("invite-stimulus").hidden = !presents;
  if (presents) { put("invite-stimulus", `New link for the ${d.title.toLowerCase()}`); at("invite-stimulus").dataset.role = d.title.toLowerCase(); }
  put("device-state", d.state); at("device-state").dataset.level = d.level;
  put("device-words", d.words);
  list("device", d.rows);
  at("clear").hidden = !view.may.includes("clear");
}

function drawAlert() {
  const own = performance.now() < said.until ? said.text : "", text = [own, view && view.alert].filter(Boolean).join(" ");
  at("alert").hidden = !text; put("alert", text);
}

function say(text, milliseconds = SAID) {
  said = { text, until: performance.now() + milliseconds };
  drawAlert();
  if (text && milliseconds < Infinity) setTimeout(drawAlert, milliseconds + 50);
}

function drawAnswers() {
  const t = view.table;
  const head = t.head.join("\u0000"), mark = JSON.stringify(t.rows);
  const table = at("answers").parentElement;
  if (table.dataset.head !== head) {
    table.dataset.head = head;
    const row = document.createElement("tr");
    row.append(...t.head.map((name) => Object.assign(document.createElement("th"), { textContent: name, scope: "col" })));
    table.tHead.replaceChildren(row);
  }
  if (at("answers").dataset.shown === mark) return;
  at("answers").dataset.shown = mark;
  at("answers").replaceChildren(...t.rows.map((r) => {
    const row = document.createElement("tr");
    row.className = r.kind;
    row.append(...r.cells.map((cell) => Object.assign(document.createElement("td"), { textContent: number(cell) })));
    if (r.restore) row.children[2].append(" ", restoring(r.restore));
    return row;
  }));
}

// The button beside a voided answer.
function restoring(meant) {
  const button = Object.assign(document.createElement("button"), { textContent: "Restore", className: "restore" });
  button.setAttribute("aria-label", `Restore the response to trial ${meant.name}`);
  button.addEventListener("click", async () => {
    const more = await sure("restore", meant);
    if (more) command("restore", more);
  });
  return button;
}

function drawLog() {
  const mark = String(view.log.length ? view.log[0] : "");
  if (at("log").dataset.shown === mark) return;
  at("log").dataset.shown = mark;
  at("log").replaceChildren(...view.log.map((cells) => {
    const item = document.createElement("li");
    item.append(...cells.map((cell) => Object.assign(document.createElement("span"), { textContent: cell })));
    return item;
  }));
}

async function loadMap() {
  try {
    const reply = await server.ask("/api/experimenter/map"), found = reply.ok ? await reply.json() : {};
    map = found.slices && found.slices.length ? found : null;
    showMap();
  } catch { mapOf = null; }
}

function showMap() {
  at("map-box").hidden = !map;
  if (!map) return;
  const { slices, ranges } = map, [low, high] = rangeOf(slices);      // equal as long as the answers say nothing of where
  const marks = slices.flatMap((s) => s.trials);
  put("scale-low", number(low, 2)); put("scale-high", number(high, 2));
  put("map-title", high > low ? "Posterior mean, slices through the optimum" : "Posterior mean: the same everywhere so far");
  put("legend", [
    high > low ? "Star: the optimum." : "", "Circles: rated stimuli, darker for higher responses, fainter away from the slice.",
    marks.some((t) => t.now) ? "Ring: the stimulus presented now." : "",
    infeasible(slices) ? "Hatched: infeasible." : "",
  ].filter(Boolean).join(" "));
  drawMap(at("map"), slices, ranges);
}
addEventListener("resize", showMap);

// What the server says to a command; null if it was refused, or nobody answers.
async function command(name, more = {}) {
  try {
    const reply = await server.ask(`/api/experimenter/${name}`, more);
    const news = await reply.json();
    say(reply.ok ? "" : news.error);
    return reply.ok ? news : null;
  } catch {
    say("The server does not respond; see the terminal in which it was started.");
    return null;
  }
}

const SURE = { abort: () => "End the session here? The responses remain; no further trial is presented.",
               void: (name) => `Void trial ${name}? Its response, if there is one, is not used; it stays in the log.`,
               restore: (name) => `Restore the response to trial ${name}? It counts again; the trial is not repeated.`,
               skip: (name) => `Leave trial ${name} out? It is not presented again, and the session ends with one response less.`,
               undo: (name) => `Undo the response to trial ${name}? The trial is presented again.` };

// What to send along: the trial that was meant when it was asked, and the reason; null for "Go back".
function sure(name, meant = view.means[name]) {
  if (!SURE[name]) return Promise.resolve({});
  const box = at("sure");
  at("sure-why").value = "";
  put("sure-text", SURE[name](meant ? meant.name : ""));
  box.returnValue = "no";
  box.showModal();
  return new Promise((done) => box.addEventListener("close", () => done(box.returnValue !== "yes" ? null
    : { reason: at("sure-why").value, ...(meant ? { trial: meant.trial } : {}) }), { once: true }));
}

for (const b of document.querySelectorAll("[data-command]")) {
  b.addEventListener("click", async () => {
    const more = await sure(b.dataset.command);
    if (more) command(b.dataset.command, more);
  });
}
for (const b of document.querySelectorAll(".stop")) {      // in the dialog too, which leaves nothing else in reach
  b.addEventListener("click", () => { command("estop"); at("sure").close("no"); });
}
at("sure-no").addEventListener("click", () => at("sure").close("no"));
document.addEventListener("keydown", (e) => {              // the first one closes a dialog, and counts
  if (e.key !== "Escape") return;
  if (performance.now() - lastEscape < 1000) command("estop");
  lastEscape = performance.now();
});
at("note").addEventListener("submit", async (e) => {
  e.preventDefault();
  const text = at("note-text").value.trim();
  if (text && await command("note", { text })) at("note-text").value = "";
});
for (const id of ["invite", "invite-stimulus"]) {
  at(id).addEventListener("click", async () => {
    const found = await command("invite", { role: at(id).dataset.role || "participant" });
    if (!found) return;
    put("link-text", found.link);
    at("qr").src = found.qr;
    at("link").hidden = false;
  });
}

function listen() {
  const source = server.listen("/api/experimenter/events", {
    open: () => say(""),
    view: (next) => { view = next; draw(); },
    moved: () => {
      source.close();
      say("A newer link of the experimenter has been opened; this page is no longer part of the session.", Infinity);
      for (const b of document.querySelectorAll("button")) b.disabled = true;
    },
    lost: (why) => say(why || "The connection to the server is gone; it is being restored.", Infinity),
  });
}
listen();
