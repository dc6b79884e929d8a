// Trades the one-time token behind the # of the link for the cookie of its role, then goes to that role's page.
"use strict";
(async () => {
  if (refusal) return;
  const title = document.getElementById("title"), texts = title.dataset;
  const token = location.hash.slice(1);
  history.replaceState(null, "", "/");
  if (!token) { title.textContent = texts.noLink; return; }
  try {
    const reply = await fetch("/api/join", {
      method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ token }),
    });
    const joined = await reply.json();
    if (reply.ok) location.replace(`/${joined.role}`);
    else title.textContent = reply.status === 401 ? texts.usedLink : joined.error;
  } catch { title.textContent = texts.noServer; }
})();
