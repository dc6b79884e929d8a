// Trades the one-time token behind the # of the link for the cookie of its role, then goes to that role's page.
"use strict";
(async () => {
  const say = (title, message) => {
    document.getElementById("title").textContent = title;
    document.getElementById("message").textContent = message;
  };
  const token = location.hash.slice(1);
  history.replaceState(null, "", "/");
  if (!token) { say("This page needs a link.", "Use the link or the QR code of the experimenter."); return; }
  try {
    const reply = await fetch("/api/join", {
      method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ token }),
    });
    const found = await reply.json();
    if (reply.ok) location.replace(`/${found.role}`);
    else say(found.error, "");
  } catch { say("The server does not answer.", "Ask the experimenter, then use the link again."); }
})();
