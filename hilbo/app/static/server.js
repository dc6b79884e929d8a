// How a page talks to the server: the key of its role, requests, and the stream of views.
//
// The key is stored for this origin alone, its port included, and every request carries it in Authorization. There is no
// cookie: browsers send cookies of a host to all of its ports by themselves (docs/guides/live.md, threat model).
"use strict";

const STORED = "hilbo.key.", ROLES = ["experimenter", "participant", "preparer"];
const AGAIN = 1000;                   // ms until a stream that has ended is requested again

// The key of a role's page. A page without one goes to where links are traded.
function keyOf(role) {
  const key = localStorage.getItem(STORED + role);
  if (!key) { location.replace("/"); throw new Error("This page has no key."); }
  return key;
}

// Requests with a key, given up after `within` ms if that is stated; `page` is the name of this window, where the server
// distinguishes windows.
function requests(key, page = "") {
  const headers = { "Content-Type": "application/json" };
  if (key) headers.Authorization = `Bearer ${key}`;
  if (page) headers["X-Hilbo-Page"] = page;

  // A GET without `content`. Without cookies, since those that other ports set may be too many for a request.
  function send(path, content, signal) {
    const body = typeof content === "string" ? content : JSON.stringify(content);
    return fetch(path, { headers, signal, credentials: "omit", ...(body === undefined ? {} : { method: "POST", body }) });
  }

  // Server-sent events: `on` has a function of the data for each name, and `open` and `lost`, which gets the server's
  // reason if there is one. Requested again after each end, until close().
  function listen(path, on) {
    let closed = false, request = null;
    (async () => {
      while (!closed) {
        let why = "";
        request = new AbortController();
        try {
          const reply = await send(path, undefined, request.signal);
          if (!reply.ok) why = (await reply.json()).error;
          else { on.open(); await events(reply.body.getReader(), (name, data) => { if (!closed && on[name]) on[name](data); }); }
        } catch { /* the network, or close() */ }
        if (closed) return;
        on.lost(why);
        await new Promise((done) => setTimeout(done, AGAIN));
      }
    })();
    return { close() { closed = true; request.abort(); } };
  }

  return { ask: (path, content, within) => send(path, content, within && timeout(within)), listen };
}

// Reads a stream to its end; `heard` gets the name and the data of each event.
async function events(reader, heard) {
  const decoder = new TextDecoder();
  for (let text = ""; ;) {
    const { done, value } = await reader.read();
    if (done) return;
    const parts = (text + decoder.decode(value, { stream: true })).split("\n\n");
    text = parts.pop();
    for (const part of parts) {
      const name = /^event: (.*)$/m.exec(part), data = /^data: (.*)$/m.exec(part);
      if (name && data) heard(name[1], JSON.parse(data[1]));
    }
  }
}

// Trades the token of a link for the key of its role, which is stored if the role has a page; { status, said }. The browser
// whose link it was shows its key, and finds its page again. `bearer`: the caller presents, as a program does.
async function join(token, bearer = false) {
  const stored = bearer ? [] : ROLES.map((role) => localStorage.getItem(STORED + role)).filter(Boolean);
  let reply = null;
  for (const key of ["", ...stored]) {
    reply = await requests(key).ask("/api/join", { token, bearer });
    if (reply.status !== 401) break;
  }
  const said = await reply.json();
  if (reply.ok && said.key && ROLES.includes(said.role)) localStorage.setItem(STORED + said.role, said.key);
  return { status: reply.status, said };
}
