// Trades the one-time token behind the # of the link for the key of its role, then goes to that role's page.
"use strict";
(async () => {
  if (refusal) return;
  const title = document.getElementById("title"), texts = title.dataset;
  const token = location.hash.slice(1);
  history.replaceState(null, "", "/");
  if (!token) { title.textContent = texts.noLink; return; }
  try {
    const { status, said } = await join(token);
    if (status === 200) location.replace(`/${said.role}`);
    else title.textContent = status === 401 ? texts.usedLink : said.error;
  } catch { title.textContent = texts.noServer; }
})();
