// Slices of the posterior mean, with axes and a colour scale: one canvas for each pair of parameters.
"use strict";

// Colour map, cividis, and the colour of the optimum: those of the figures of reports.
const STOPS = [[0, 34, 78], [26, 56, 111], [67, 78, 108], [97, 101, 111], [125, 124, 120], [155, 148, 118], [188, 174, 108], [222, 201, 88], [254, 232, 56]];
const OPTIMUM = "#d55e00", INK = "#111";

function colour(share) {
  const s = Math.min(1, Math.max(0, share)) * (STOPS.length - 1), i = Math.min(STOPS.length - 2, Math.floor(s)), f = s - i;
  return STOPS[i].map((v, k) => Math.round(v + f * (STOPS[i + 1][k] - v)));
}

// The smallest and the largest mean of all slices, which share one scale.
function rangeOf(slices) {
  const values = slices.flatMap((s) => s.mean.flat()).filter((v) => v !== null);
  return [Math.min(...values), Math.max(...values)];
}

const infeasible = (slices) => slices.some((s) => s.mean.some((row) => row.includes(null)));

// The mean on a square of `side` pixels; hatched where nothing can be presented.
function drawMean(c, slice, range, side) {
  const n = slice.mean.length, d = side / n, small = new OffscreenCanvas(n, n), p = small.getContext("2d"), image = p.createImageData(n, n);
  slice.mean.forEach((row, j) => row.forEach((value, i) => {
    const [r, g, b] = value === null ? [232, 229, 222] : colour((value - range[0]) / (range[1] - range[0] || 1));
    image.data.set([r, g, b, 255], 4 * ((n - 1 - j) * n + i));
  }));
  p.putImageData(image, 0, 0);
  c.imageSmoothingEnabled = false;
  c.drawImage(small, 0, 0, side, side);
  c.strokeStyle = "#9a948a"; c.lineWidth = 1;
  c.beginPath();
  slice.mean.forEach((row, j) => row.forEach((value, i) => {
    if (value === null && (i + j) % 3 === 0) { c.moveTo(i * d, side - j * d); c.lineTo((i + 1) * d, side - (j + 1) * d); }
  }));
  c.stroke();
}

// The optimum: a star with a white outline.
function star(c, x, y) {
  c.beginPath();
  for (let k = 0; k < 10; k++) {
    const r = k % 2 ? 4.2 : 10.5, a = Math.PI * k / 5;
    c.lineTo(x + r * Math.sin(a), y - r * Math.cos(a));
  }
  c.closePath(); c.lineJoin = "round"; c.lineWidth = 3; c.strokeStyle = "#fff"; c.stroke(); c.fillStyle = OPTIMUM; c.fill();
}

function ring(c, x, y, radius) { c.beginPath(); c.arc(x, y, radius, 0, 7); c.stroke(); }

function twice(c, widths, draw) {                                 // a light outline, so that it is seen on any colour
  for (const [style, width] of [["#fff", widths[0]], [INK, widths[1]]]) { c.strokeStyle = style; c.lineWidth = width; draw(); }
}

function dot(c, x, y, t) {
  if (t.now) { twice(c, [5, 2.5], () => ring(c, x, y, 7)); return; }
  c.beginPath(); c.arc(x, y, 4.5, 0, 7);
  c.globalAlpha = 1 - .75 * Math.min(1, t.away);                  // fainter the farther from the slice
  const g = Math.round(255 * (1 - t.level)); c.fillStyle = `rgb(${g},${g},${g})`; c.fill();
  c.lineWidth = 1.2; c.strokeStyle = t.level > .5 ? "#fff" : INK; c.stroke();
  c.globalAlpha = 1;
}

// `across` and `up`: name, unit, scale, low, high, levels; with `hidden_unit` in both, the truth is marked too.
function drawSlice(canvas, slice, across, up, range) {
  const ratio = devicePixelRatio, w = canvas.clientWidth, h = canvas.clientHeight, c = canvas.getContext("2d");
  const text = w < 320 ? 12 : 14, names = (up.levels || []).length, left = (names ? 6 : 3.4) * text + 10;
  const foot = 2.9 * text + 4, head = 1.2 * text + 4, font = "px system-ui, sans-serif";
  const side = Math.min(w - left - 8, h - head - foot), x = (w - side + left - 8) / 2, y = head + (h - head - foot - side) / 2;
  canvas.width = w * ratio; canvas.height = h * ratio;
  c.scale(ratio, ratio);
  c.save(); c.translate(x, y); drawMean(c, slice, range, side); c.restore();
  const count = (p) => (p.levels || []).length;         // of unordered levels: bands of one width, each with a tick
  const shown = (p, u) => count(p) ? (Math.round(u * (count(p) - 1)) + .5) / count(p) : u;
  const place = (u, v) => [x + shown(across, u) * side, y + (1 - shown(up, v)) * side];
  for (const t of slice.trials) dot(c, ...place(t.x, t.y), t);
  if (range[1] > range[0]) star(c, ...place(...slice.best));
  if (across.hidden_unit !== undefined) twice(c, [6, 3], () => ring(c, ...place(across.hidden_unit, up.hidden_unit), 13));
  c.fillStyle = "#1d2733"; c.font = text + font; c.textAlign = "center";
  if (slice.held) c.fillText(`at ${slice.held}`, x + side / 2, y - 6);
  const ticks = (p) => count(p) ? p.levels.map((_, i) => (i + .5) / count(p)) : [0, 0.5, 1];
  const value = (p, u) => count(p) ? p.levels[Math.floor(count(p) * u)] : Number((p.scale === "log" ? p.low * (p.high / p.low) ** u : p.low + (p.high - p.low) * u).toPrecision(2));
  for (const u of ticks(across)) {
    c.textAlign = u === 0 ? "left" : u === 1 ? "right" : "center";
    c.fillText(value(across, u), x + u * side, y + side + 1.2 * text, side / ticks(across).length);
  }
  c.textAlign = "right";
  for (const u of ticks(up)) {
    c.fillText(value(up, u), x - 5, y + (1 - u) * side + (u === 1 ? .8 * text : u === 0 ? 0 : .35 * text), left - (names ? 2.2 : 1.2) * text);
  }
  const label = (p) => p.name + (p.unit ? ` (${p.unit})` : "");
  c.font = `600 ${text}${font}`; c.textAlign = "center";
  c.fillText(label(across), x + side / 2, y + side + 2.6 * text);
  c.translate(x - left + text, y + side / 2); c.rotate(-Math.PI / 2); c.fillText(label(up), 0, 0);
}

// A canvas for each slice in `box`; `parameters` is name -> what an axis needs.
function drawMap(box, slices, parameters) {
  const range = rangeOf(slices), axis = (name) => ({ name, ...parameters[name] });
  if (box.childElementCount !== slices.length) box.replaceChildren(...slices.map(() => document.createElement("canvas")));
  slices.forEach((slice, k) => {
    const canvas = box.children[k];
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `${slice.across} across, ${slice.up} up` + (slice.held ? `, at ${slice.held}` : ""));
    drawSlice(canvas, slice, axis(slice.across), axis(slice.up), range);
  });
}
