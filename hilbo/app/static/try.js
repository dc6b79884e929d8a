// The page of `hilbo try`: a program that presents two soft blocks, and the page of the participant who compares them.
//
// One force (N), set by the mouse, acts on both blocks; each surface shows the displacement (mm) that follows. The server
// orders what is shown (docs/guides/stimulus.md), asks (docs/guides/live.md) and chooses. The page knows the reference: its answers are
// unblinded, and the log says so.
"use strict";

// ---- The FO-SLS under force: the recursion of firmware/core/hb_renderer.c with full memory, solved for the position.
//
// The device computes F = K0 x + k (x - s) with k = K1 beta/(K1 + beta), s = sum of weight_k m_k. Of the same sample, with the
// same s, x = (F + k s)/(K0 + k) is the exact inverse; y = s + g (x - s) and m_k += loss_k (y - m_k) are the device's.

function exponentials(table, alpha) {
  // Weights, and losses 1 - lambda, of the memory of order alpha: hilbo.mechanics.exponentials, whose table this is.
  const x = 2 * alpha - 1, basis = [1, x];
  while (basis.length < table[0].length) basis.push(2 * x * basis[basis.length - 1] - basis[basis.length - 2]);
  const values = table.map((row) => row.reduce((sum, c, i) => sum + c * basis[i], 0));
  const half = values.length / 2, rates = values.slice(0, half).map(Math.exp);
  rates[half - 1] *= alpha;
  const raw = [1, ...values.slice(half).map(Math.exp)];
  raw.forEach((w, k) => { raw[k] = w * (k === 0 ? alpha : k === half ? 1 - alpha : alpha * (1 - alpha)); });
  const total = raw.reduce((a, b) => a + b), weight = raw.map((w) => w / total);
  const rest = rates.reduce((sum, r, k) => sum + weight[k + 1] * Math.tanh(r / 2), 0);
  const speed = (Math.expm1(alpha * Math.LN2) - rest) / weight[0];
  return { weight, loss: [2 * speed / (1 + speed), ...rates.map((r) => -Math.expm1(-r))] };
}

class Block {
  // At rest. `set`: K1 (N/mm), B1 (N.s^alpha/mm), alpha; `fixed`: K0 (N/mm), T (s) and the table of exponentials.
  constructor(set, fixed) {
    const beta = set.B1 * fixed.T ** -set.alpha;
    this.gain = set.K1 / (set.K1 + beta);
    this.stiffness = set.K1 * beta / (set.K1 + beta);
    this.K0 = fixed.K0;
    Object.assign(this, exponentials(fixed.table, set.alpha));
    this.means = this.weight.map(() => 0);
    this.x = 0;
  }

  step(force) {
    let past = 0;
    for (let k = 0; k < this.means.length; k++) past += this.weight[k] * this.means[k];
    this.x = (force + this.stiffness * past) / (this.K0 + this.stiffness);
    const y = past + this.gain * (this.x - past);
    for (let k = 0; k < this.means.length; k++) this.means[k] += this.loss[k] * (y - this.means[k]);
    return this.x;
  }
}

// ---- What the page is told, and what it says.

const MOST = 3, PRESS = 1, KEY = 2;        // N at most; of a mere press of the mouse; of the space bar
const TRAVEL = 200;                        // px of the mouse from none to all of it
const SMOOTH = 0.05, SETTLE = 0.07;        // s in which the force follows the mouse, and a block that is taken away goes flat
const HEIGHT = 12;                         // mm of a block
const HINT = "Press on the blocks and hold, or hold Space; pull down for more force. Let go, and see how they recover.";
const at = (id) => document.getElementById(id);
const put = (id, text) => { const e = at(id); if (e.textContent !== text) e.textContent = text; };
const sleep = (ms) => new Promise((done) => setTimeout(done, ms));
const random = () => Array.from(crypto.getRandomValues(new Uint8Array(12)), (b) => b.toString(16).padStart(2, "0")).join("");
const page = typeof crypto === "undefined" ? "" : random();   // this window's name
const state = {
  participant: null, stimulus: null, facts: null, view: null, order: { order: 0, do: "neutral" }, blocks: null, depths: [0, 0],
  held: null, wanted: 0, force: 0, begun: false, sending: false, asked: 0, over: false, then: 0, left: 0,
};

async function ask(path, body) {      // the participant's key for what participants ask, else the stimulus'
  const server = path.startsWith("/api/participant") ? state.participant : state.stimulus;
  const reply = await server.ask(path, body, 15000);
  return { status: reply.status, ok: reply.ok, said: await reply.json().catch(() => ({})) };
}

function end(sentence) {
  state.over = true;
  release();
  put("title", sentence); put("words", ""); at("begin").hidden = true; at("card").hidden = false;
}

async function enter() {
  // The link contains the tokens of the participant and of the stimulus; the keys outlive a reload of the page.
  const [participant, stimulus] = location.hash.slice(1).split(".");
  history.replaceState(null, "", "/try");
  if (stimulus) {
    for (const [token, bearer] of [[participant, false], [stimulus, true]]) {
      const { status, said } = await join(token, bearer);
      if (status !== 200) return said.error;
      if (bearer) sessionStorage.setItem("hilbo.try", said.key);
    }
  }
  state.participant = requests(localStorage.getItem(`${STORED}participant`) || "", page);
  state.stimulus = requests(sessionStorage.getItem("hilbo.try") || "");
  const { ok, said } = await ask("/api/try");
  if (!ok) return "This page needs the link that hilbo try gave; start hilbo try again.";
  state.facts = said;
  return null;
}

async function present() {
  // The program that presents: it does what the newest order says, says so, and waits for the next.
  let run = null, waited = 0;
  let had = sessionStorage.getItem("hilbo.try.run") || "";   // of this window before it was loaded again: its own place
  while (!state.over) {
    try {
      const said = { name: "hilbo try", version: "1", force: false, neutral_within_s: 1, run: had };
      const order = state.order, shows = order.do === "present";
      const report = { run, order: order.order, state: shows ? "presented" : "neutral", wait_s: 1 };
      if (shows) Object.assign(report, { trial: order.trial, values: order.values });
      const reply = await (run ? ask("/api/stimulus", report) : ask("/api/stimulus/hello", said));
      if (reply.ok) {
        if (reply.said.run) sessionStorage.setItem("hilbo.try.run", had = run = reply.said.run);
        waited = 0; put("hint", HINT); obey(reply.said);
        if (state.view) receive(state.view);
      }
      else if (reply.status === 409 && reply.said.order) obey(reply.said);
      else if (reply.status === 409 && run) run = null;
      else if (reply.status === 409) {                            // until the other window is no longer taken for heard
        if (++waited > 10) put("hint", "Another window had this session; it continues here in a few seconds.");
        await sleep(200);
      }
      else { end(reply.said.error || "The server does not answer any more."); return; }
    } catch {
      run = null;
      obey({ order: 0, do: "neutral" });
      put("hint", "hilbo try does not respond. It may have been ended in its terminal.");
      await sleep(1000);
    }
  }
}

function obey(order) {
  const before = state.order;
  state.order = order;
  if (order.do === "present" && order.trial !== before.trial) {
    state.blocks = [state.facts.reference, order.values].map((set) => new Block(set, state.facts));
    state.asked = performance.now();
  } else if (order.do !== "present") { state.blocks = null; release(); }
}

function listen() {
  const source = state.participant.listen("/api/participant/events", {
    open: () => {}, view: receive, moved: (news) => { source.close(); end(news.error); }, lost: () => { if (state.over) source.close(); },
  });
  setInterval(() => { if (!state.over) ask("/api/participant/here", {}).catch(() => {}); }, 1000);
}

function receive(view) {
  state.view = view;
  if (state.over) return;
  if (view.phase === "done" || view.phase === "ended") { state.over = true; release(); results(); return; }
  const question = view.questions && view.questions[0], asks = question && !state.sending && state.blocks;
  put("progress", view.progress.text);
  at("bar").style.width = `${100 * view.progress.done / view.progress.of}%`;
  if (question) { put("question", question.text); at("answers").dataset.trial = view.trial.id; }
  document.querySelectorAll("#answers button").forEach((b, i) => {
    b.disabled = !asks;
    if (question) b.firstElementChild.textContent = question.options[i].label;
  });
  at("card").hidden = state.begun && !view.may.begin;
  const may = view.may.begin && state.order.order > 0;         // not before this window presents
  at("begin").disabled = !may;
  put("begin", may ? "Begin" : "Getting ready …");
}

async function begin() {
  const reply = await ask("/api/participant/begin", {}).catch(() => null);
  if (reply) { state.begun = true; if (reply.said.view) receive(reply.said.view); }
}

async function answer(i) {
  const view = state.view, question = view && view.questions && view.questions[0];
  if (!question || state.sending || !state.blocks) return;
  state.sending = true;
  receive(view);
  const body = {
    trial: view.trial.id, client: `try-${page}`, answers: { [question.name]: question.options[i].value },
    clicked: new Date().toISOString(), response_ms: Math.round(performance.now() - state.asked),
  };
  for (let reply = null; !reply && !state.over;) {   // until the server has it; it counts once
    reply = await ask("/api/participant/answer", body).catch(() => null);
    if (!reply || reply.status === 503) { reply = null; await sleep(1000); }
    else { state.sending = false; if (reply.said.view) receive(reply.said.view); }
  }
}

// ---- The force, and what is drawn.

function press(y) { if (state.blocks && state.held === null) { state.held = y; pull(y); } }
function pull(y) { if (state.held !== null) state.wanted = Math.min(MOST, Math.max(0, PRESS + MOST * (y - state.held) / TRAVEL)); }
function release() { state.held = null; state.wanted = 0; }

function advance(now) {
  // As many samples as time has passed; what a hidden page has missed is passed over after 2 s.
  const seconds = Math.min(2, (now - state.then) / 1000);
  state.then = now;
  if (!state.blocks) {
    state.left = state.force = 0;
    state.depths = state.depths.map((x) => x * Math.exp(-seconds / SETTLE));
    return;
  }
  const T = state.facts.T;
  for (state.left += seconds; state.left >= T; state.left -= T) {
    state.force += (state.wanted - state.force) * T / SMOOTH;
    state.depths = state.blocks.map((block) => block.step(state.force));
  }
}

function frame(now) {
  advance(now);
  if (!at("stage").hidden) draw(at("blocks"));
  requestAnimationFrame(frame);
}

function draw(canvas) {
  const ratio = devicePixelRatio, w = canvas.clientWidth, h = canvas.clientHeight, c = canvas.getContext("2d");
  canvas.width = Math.round(w * ratio); canvas.height = Math.round(h * ratio);   // which also clears it
  c.scale(ratio, ratio);
  const narrow = w < 600, wide = narrow ? 0.34 : 0.4, places = narrow ? [0.31, 0.79] : [0.27, 0.73];   // on a phone the rulers need room
  const size = { w: Math.min(w * wide, 1.75 * h), h: h * 0.64, top: h * 0.27, scale: h * 0.64 / HEIGHT };
  drawBlock(c, w * places[0], size, state.depths[0], "Reference", "#1f5673", "#cfe0e8");
  drawBlock(c, w * places[1], size, state.depths[1], "Test", "#8a4b00", "#f6ddb8");
  c.fillStyle = "#1d2733"; c.textAlign = "center";
  c.font = "600 20px system-ui, sans-serif"; c.fillText(`${state.force.toFixed(1)} N`, w / 2, size.top - 62);
  c.font = "14px system-ui, sans-serif"; c.fillStyle = "#4a5663"; c.fillText("on both", w / 2, size.top - 40);
}

function drawBlock(c, x, size, depth, name, ink, fill) {
  const left = x - size.w / 2, punch = size.w * 0.13, sink = depth * size.scale, bottom = size.top + size.h;
  const down = (r) => sink * Math.exp(-((Math.max(0, Math.abs(r) - punch) / (size.w * 0.11)) ** 1.6));
  const layer = (share) => {             // a line that lay at this share of the height
    for (let i = 0; i <= 80; i++) {
      const r = (i / 80 - 0.5) * size.w;
      c.lineTo(x + r, size.top + share * size.h + down(r) * (1 - share));
    }
  };
  c.beginPath(); layer(0); c.lineTo(left + size.w, bottom); c.lineTo(left, bottom); c.closePath();
  c.fillStyle = fill; c.fill(); c.strokeStyle = ink; c.lineWidth = 2.5; c.lineJoin = "round"; c.stroke();
  c.lineWidth = 1; c.globalAlpha = 0.45;
  for (const share of [1 / 6, 2 / 6, 3 / 6, 4 / 6, 5 / 6]) { c.beginPath(); layer(share); c.stroke(); }
  c.globalAlpha = 1;
  drawRuler(c, left, size, ink);
  const foot = size.top + sink, head = foot - 46;
  c.fillStyle = c.strokeStyle = "#4a5663"; c.lineWidth = 8;          // a stroke that joins round makes the corners round
  c.beginPath(); c.rect(x - punch + 4, head + 4, 2 * punch - 8, 38); c.fill(); c.stroke();
  const long = state.force / MOST * (size.top - 62);
  if (long > 1) {
    c.strokeStyle = c.fillStyle = "#a3161c"; c.lineWidth = 5;
    c.beginPath(); c.moveTo(x, head - 8 - long); c.lineTo(x, head - 8); c.stroke();
    c.beginPath(); c.moveTo(x, head - 1); c.lineTo(x - 9, head - 13); c.lineTo(x + 9, head - 13); c.fill();
  }
  c.fillStyle = ink; c.textAlign = "center"; c.font = "600 18px system-ui, sans-serif"; c.fillText(name, x, bottom + 26);
}

function drawRuler(c, left, size, ink) {
  // Millimetres below the surface at rest, beside the block.
  c.strokeStyle = c.fillStyle = ink; c.lineWidth = 1; c.textAlign = "right"; c.font = "13px system-ui, sans-serif";
  for (let mm = 0, y = size.top; mm <= HEIGHT; mm += 2, y += 2 * size.scale) {
    c.beginPath(); c.moveTo(left - 4, y); c.lineTo(left - 12, y); c.stroke();
    c.fillText(String(mm), left - 16, y + 4.5);
  }
  c.fillText("mm", left - 4, size.top - 10);
}

async function results() {               // the end: one's own map
  let reply = null, heard = performance.now();
  while (!reply || !reply.said.slices) {
    reply = await ask("/api/try/map").catch(() => null);
    if (reply) heard = performance.now();
    if (performance.now() - heard > 10000) { end("The server has ended before the map was ready; its log holds your answers."); return; }
    await sleep(200);
  }
  const { slices, parameters } = reply.said, shown = (v) => Number(v.toPrecision(3));
  at("stage").hidden = true; at("results").hidden = false;
  put("progress", `${slices[0].trials.length} answers`);
  at("bar").style.width = "100%";
  const off = Math.hypot(...parameters.map((p) => p.optimum_unit - p.hidden_unit)) / Math.sqrt(parameters.length);
  put("verdict", `The optimum of your map is ${Math.round(100 * off)} % of the ranges away from the hidden reference (root mean square).`);
  at("values").replaceChildren(...parameters.map((p) => {
    const cells = [p.name + (p.unit ? ` (${p.unit})` : ""), shown(p.hidden), shown(p.optimum), `${p.low} to ${p.high}`];
    const row = document.createElement("tr");
    row.append(...cells.map((text) => Object.assign(document.createElement("td"), { textContent: text })));
    return row;
  }));
  const by = Object.fromEntries(parameters.map((p) => [p.name, p]));
  const all = () => drawMap(at("maps"), slices, by);
  addEventListener("resize", all);
  all();
}

async function main() {
  const wrong = await enter().catch(() => "The server does not answer; start hilbo try again.");
  if (wrong) { end(wrong); return; }
  const stage = at("blocks");
  stage.addEventListener("pointerdown", (e) => { stage.setPointerCapture(e.pointerId); press(e.clientY); });
  stage.addEventListener("pointermove", (e) => pull(e.clientY));
  for (const kind of ["pointerup", "pointercancel", "lostpointercapture"]) stage.addEventListener(kind, release);
  addEventListener("blur", release);
  at("begin").addEventListener("click", begin);
  document.querySelectorAll("#answers button").forEach((b, i) => b.addEventListener("click", () => answer(i)));
  addEventListener("keydown", (e) => {
    if (e.repeat || e.ctrlKey || e.altKey || e.metaKey) return;
    if (digit(e) >= 1 && digit(e) <= 3) { answer(digit(e) - 1); e.preventDefault(); }
    else if (e.key === " " && at("card").hidden) { if (state.blocks) state.wanted = KEY; e.preventDefault(); }
  });
  addEventListener("keyup", (e) => { if (e.key === " ") release(); });
  listen();
  present();
  requestAnimationFrame((now) => { state.then = now; frame(now); });
}

if (typeof document !== "undefined" && !refusal) main();
