// The participant's page: shows the view that the server sends, counts down, and hands answers over, each exactly once.
//
// An answer is kept in localStorage from the click to the server's acknowledgement, and sent again, the same bytes, after
// every failure and at every new start of the page; the server takes it once, by trial and client.
"use strict";
if (refusal) throw new Error(refusal);

const KEPT = "hilbo.answer", CLIENT = "hilbo.client";
const at = (id) => document.getElementById(id);
const random = () => Array.from(crypto.getRandomValues(new Uint8Array(12)), (b) => b.toString(16).padStart(2, "0")).join("");
const client = localStorage.getItem(CLIENT) || random();
localStorage.setItem(CLIENT, client);
const page = random();               // this window; the newest one of a participant is the one that counts
const server = requests(keyOf("participant"), page);

let view = null;                     // what the server said last
let answers = {}, asked = 0;         // of the question that is on the page
let shortest = Infinity;             // ms from a question to its answer, the shortest of this trial
let shownAt = 0, stepEnds = 0;       // performance.now()
let laidOut = 0, goAt = 0;           // when the answers' buttons and Begin came up
const WITHIN = 15000;                // ms until a request is given up
const SETTLES = 300;                 // ms: a tap or key that comes sooner was for what stood there before
let trial = null;                    // id of the trial on the page
let cued = null;                     // the trial whose question came up while it was still being felt
let sending = false, connected = false, over = false;
let source = null, calling = false, silent = false;   // the stream of views; a sign of life under way; none got through
let refused = "";                    // the server's reason for refusing the stream

function words(name) { return (view && view.texts && view.texts[name]) || ""; }
function put(id, text) { const e = at(id); if (e.textContent !== text) e.textContent = text; }
function show(id, yes) { at(id).hidden = !yes; }

function receive(next) {
  const fresh = !view || !next.trial || next.trial.id !== trial;
  view = next;
  trial = next.trial ? next.trial.id : null;
  if (fresh) restart();
  if (next.step) stepEnds = performance.now() + 1000 * next.step.left;
  if (next.questions && !shownAt) shownAt = performance.now();
  if (!next.questions) { shownAt = 0; restart(); }
  document.documentElement.lang = next.lang || "en";
  document.title = words("page_title");
  draw();
}

function restart() { answers = {}; asked = 0; shortest = Infinity; }

function kept() {
  try { return JSON.parse(localStorage.getItem(KEPT)); } catch { return null; }
}

function draw() {
  if (!view) return;
  const waiting = kept(), q = waiting || over ? null : view.questions && view.questions[asked];
  document.body.dataset.phase = waiting ? "saving" : view.phase;
  document.body.dataset.trial = trial || "";
  if (q && view.step) cued = trial;
  document.body.classList.toggle("choosing", !!q);
  document.body.classList.toggle("cue", !!q && cued === trial);
  const bar = view.progress;
  put("progress-text", bar ? bar.text : "");
  at("progress").firstElementChild.style.width = bar ? `${100 * bar.done / bar.of}%` : "0";
  at("progress").setAttribute("aria-valuenow", bar ? bar.done : 0);
  at("progress").setAttribute("aria-valuemax", bar ? bar.of : 1);
  drawSteps();
  put("title", waiting ? words("saving") : q ? q.text : view.title || "");
  put("message", waiting || q ? "" : view.message || "");
  show("clock", !waiting && !over && !!view.step && view.step.seconds > 0);
  drawOptions(q);
  drawButton("go", !waiting && !over && view.may.begin && !q, words("begin"));
  show("more", !waiting && !over && view.may.more && !q); put("more", words("more"));
  show("break", !waiting && !over && view.may.break); put("break", words("break"));
  show("line", !connected && !over); put("line", refused || words("disconnected") || "The connection is gone; it is being restored.");
}

function drawSteps() {
  const list = at("steps"), names = view.step ? view.step.labels : [];
  if (list.childElementCount !== names.length || names.some((n, i) => list.children[i].textContent !== n)) {
    list.replaceChildren(...names.map((name) => Object.assign(document.createElement("li"), { textContent: name })));
  }
  names.forEach((_, i) => { list.children[i].className = i < view.step.index ? "past" : i === view.step.index ? "now" : ""; });
}

function drawButton(id, yes, text) {
  if (yes && at(id).hidden) goAt = performance.now();
  show(id, yes);
  at(id).firstElementChild.textContent = text;
  at(id).lastElementChild.textContent = words("space_key");
}

function drawOptions(q) {
  const box = at("options"), mark = q ? `${trial} ${q.name}` : "";
  show("options", !!q);
  if (box.dataset.question === mark) return;
  box.dataset.question = mark;
  laidOut = performance.now();
  box.replaceChildren(...(q ? q.options : []).map((option, i) => {
    const b = document.createElement("button");
    for (const [kind, text] of [["label", option.label], ["text", option.text]]) {
      if (text) b.append(Object.assign(document.createElement("span"), { className: kind, textContent: text }));
    }
    b.append(Object.assign(document.createElement("kbd"), { textContent: String(i + 1) }));
    b.dataset.value = option.value;
    b.addEventListener("click", () => choose(i));
    return b;
  }));
}

function choose(i) {
  if (performance.now() - laidOut <= SETTLES) return;
  const q = view && !kept() && !over && view.questions && view.questions[asked];
  if (!q || !q.options[i]) return;
  answers[q.name] = q.options[i].value;
  shortest = Math.min(shortest, Math.round(performance.now() - laidOut));
  asked += 1;
  if (asked < view.questions.length) { draw(); return; }
  localStorage.setItem(KEPT, JSON.stringify({
    trial, client, answers, clicked: new Date().toISOString(), response_ms: Math.round(performance.now() - shownAt),
    ...(view.questions.length > 1 ? { shortest_ms: shortest } : {}),
  }));
  draw();
  hand();
}

async function hand() {
  if (sending || over) return;
  const body = localStorage.getItem(KEPT);
  if (!body) return;
  sending = true;
  let again = 1000;
  try {
    const reply = await server.ask("/api/participant/answer", body, WITHIN);
    // Taken, or settled otherwise: a refused one (4xx) is of a trial that is over, and the server has logged that.
    if (reply.ok || (reply.status >= 400 && reply.status < 500 && reply.status !== 429)) {
      if (reply.status === 401 || reply.status === 403) { again = 0; ended(await reply.json()); }
      else if (localStorage.getItem(KEPT) === body) localStorage.removeItem(KEPT);
      again = 0;
      const news = await reply.json().catch(() => null);
      if (news && news.view) receive(news.view);
    }
  } catch { /* the network: again below */ }
  sending = false;
  draw();
  if (again) setTimeout(hand, again);
}

async function press(what) {
  if (!view || over) return;
  try {
    const reply = await server.ask(`/api/participant/${what}`, { trial }, WITHIN);
    const news = await reply.json().catch(() => null);
    if (news && news.view) receive(news.view);
  } catch { connected = false; draw(); }
}

function ended(news) {
  over = true;
  view = view || { phase: "over", texts: {}, may: {} };
  view = { ...view, phase: "over", title: news.error || words("moved"), message: "", questions: null, step: null, may: {} };
  draw();
}

function listen() {
  if (source) source.close();
  source = server.listen("/api/participant/events", {
    open: () => { connected = true; refused = ""; draw(); hand(); },
    view: (next) => { connected = true; receive(next); },
    moved: (news) => { source.close(); ended(news); },
    lost: (why) => { connected = false; refused = why; draw(); },
  });
}

// A sign of life every second, since an open stream says nothing of a network that went silently, to either side.
async function here() {
  if (over || calling) return;
  calling = true;
  try {
    await server.ask("/api/participant/here", {}, 2500);
    if (silent && !over) { silent = false; listen(); }
  } catch { silent = true; connected = false; source.close(); draw(); }
  calling = false;
}

function tick() {
  if (view && view.step) {
    const left = Math.max(0, stepEnds - performance.now()) / 1000;
    put("seconds", String(Math.ceil(left)));
    document.querySelector("#clock .left").style.strokeDasharray = `${100 * left / view.step.seconds} 100`;
  }
  requestAnimationFrame(tick);
}

document.addEventListener("keydown", (e) => {
  if (e.repeat || e.ctrlKey || e.altKey || e.metaKey) return;
  document.body.classList.add("keys");
  if (digit(e)) { choose(digit(e) - 1); e.preventDefault(); }
  else if ((e.key === " " || e.key === "Enter") && !at("go").hidden && !(e.target instanceof HTMLButtonElement)) {
    go(); e.preventDefault();
  }
});
function go() { if (performance.now() - goAt > SETTLES) press("begin"); }
at("go").addEventListener("click", go);
at("more").addEventListener("click", () => press("more"));
at("break").addEventListener("click", () => press("break"));
setInterval(() => { if (kept()) hand(); }, 3000);
setInterval(here, 1000);
listen();
tick();
