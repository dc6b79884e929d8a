// What every page needs of a browser: a page that cannot work says why, in place of staying blank.
//
// Minimum (docs/guides/live.md): Chrome and Edge 86, Firefox 98, Safari 15.4. This file is written for older ones, which
// cannot read the scripts that follow.
"use strict";

var refusal = "";                     // why the page does not run; the scripts that follow do nothing then

function refusePage(sentence) {
  refusal = sentence;
  document.body.textContent = sentence;
  document.body.className = "refusal";
  document.body.setAttribute("role", "alert");
}

// A browser that is too old reports a syntax error in the scripts that follow. Later ones are of data, not of scripts.
var TOO_OLD = "This browser is too old for this page. Use Chrome or Edge 86, Firefox 98, Safari 15.4, or a newer version.";
function onError(e) { if (e.error instanceof SyntaxError) refusePage(TOO_OLD); }
window.addEventListener("error", onError);
document.addEventListener("DOMContentLoaded", function () { window.removeEventListener("error", onError); });
if (!window.fetch || !window.ReadableStream || !window.TextDecoder || !window.AbortController || !window.crypto || !document.body.replaceChildren) {
  refusePage(TOO_OLD);
}
try {
  localStorage.setItem("hilbo.check", "1");
  localStorage.removeItem("hilbo.check");
  sessionStorage.getItem("hilbo.check");
} catch (error) {
  refusePage("This browser lets the page store nothing, so that an answer could be lost. Allow site data (cookies) for "
    + location.host + ", then load the page again.");
}

// The signal of a request that is given up after so many milliseconds.
function timeout(milliseconds) {
  var controller = new AbortController();
  setTimeout(function () { controller.abort(); }, milliseconds);
  return controller.signal;
}

// The digit of a key by its place, 0 for another key: without Shift, the upper row of a French keyboard gives & é ".
function digit(e) {
  var found = e.key.length === 1 && (/^(?:Digit|Numpad)([1-9])$/.exec(e.code) || /^([1-9])$/.exec(e.key));
  return found ? Number(found[1]) : 0;
}
