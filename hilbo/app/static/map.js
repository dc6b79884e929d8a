// Slices of the posterior mean on canvases: one for each pair of parameters.
"use strict";

const STOPS = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];

function colour(share) {
  const s = Math.min(1, Math.max(0, share)) * (STOPS.length - 1), i = Math.min(STOPS.length - 2, Math.floor(s)), f = s - i;
  return STOPS[i].map((v, k) => Math.round(v + f * (STOPS[i + 1][k] - v)));
}

function drawSlice(canvas, slice, range, side = 240) {
  const n = slice.mean.length, c = canvas.getContext("2d");
  canvas.width = canvas.height = side;
  const small = new OffscreenCanvas(n, n), p = small.getContext("2d"), image = p.createImageData(n, n);
  slice.mean.forEach((row, j) => row.forEach((value, i) => {
    const k = 4 * ((n - 1 - j) * n + i);
    const [r, g, b] = value === null ? [232, 229, 222] : colour((value - range[0]) / (range[1] - range[0] || 1));
    image.data.set([r, g, b, 255], k);
  }));
  p.putImageData(image, 0, 0);
  c.imageSmoothingEnabled = false;
  c.drawImage(small, 0, 0, side, side);
  c.save();
  c.strokeStyle = "#9a948a"; c.lineWidth = 1;
  c.beginPath();
  const d = side / n;
  slice.mean.forEach((row, j) => row.forEach((value, i) => {
    if (value === null && (i + j) % 3 === 0) { c.moveTo(i * d, side - j * d); c.lineTo((i + 1) * d, side - (j + 1) * d); }
  }));
  c.stroke(); c.restore();
  for (const t of slice.trials) dot(c, t.x * side, side - t.y * side, t);
  const [x, y] = [slice.best[0] * side, side - slice.best[1] * side];
  c.strokeStyle = "#fff"; c.lineWidth = 4; cross(c, x, y); c.strokeStyle = "#111"; c.lineWidth = 1.8; cross(c, x, y);
}

function cross(c, x, y) {
  c.beginPath(); c.moveTo(x - 6, y); c.lineTo(x + 6, y); c.moveTo(x, y - 6); c.lineTo(x, y + 6); c.stroke();
}

function dot(c, x, y, t) {
  c.beginPath(); c.arc(x, y, t.now ? 7 : 4.5, 0, 7);
  c.globalAlpha = t.now ? 1 : 1 - .75 * Math.min(1, t.away);      // fainter the farther from the slice
  if (!t.now) { const g = Math.round(255 * (1 - t.level)); c.fillStyle = `rgb(${g},${g},${g})`; c.fill(); }
  c.lineWidth = t.now ? 2.5 : 1.2; c.strokeStyle = t.now ? "#d1495b" : "#fff"; c.stroke();
  c.globalAlpha = 1;
}

function drawMap(box, map) {
  const values = map.slices.flatMap((s) => s.mean.flat()).filter((v) => v !== null);
  const range = [Math.min(...values), Math.max(...values)];
  map.slices.forEach((slice, k) => {
    let figure = box.children[k];
    if (!figure) {
      figure = document.createElement("figure");
      figure.append(document.createElement("canvas"), document.createElement("figcaption"));
      figure.lastChild.append(document.createElement("span"), document.createElement("span"));
      box.append(figure);
    }
    figure.firstChild.setAttribute("role", "img");
    figure.firstChild.setAttribute("aria-label", `${slice.across} across, ${slice.up} up; ${slice.held}`);
    figure.lastChild.firstChild.textContent = `→ ${slice.across}   ↑ ${slice.up}`;
    figure.lastChild.lastChild.textContent = slice.held;
    drawSlice(figure.firstChild, slice, range);
  });
}

// One slice with its axes and, where it was hidden, the truth; the page of hilbo try.
function drawWithAxes(canvas, slice, across, up, range) {
  const ratio = devicePixelRatio, w = canvas.clientWidth, h = canvas.clientHeight, c = canvas.getContext("2d");
  const side = Math.min(w - 78, h - 74), x = (w - side + 58) / 2, y = (h - side - 26) / 2, inner = document.createElement("canvas");
  canvas.width = w * ratio; canvas.height = h * ratio;
  c.scale(ratio, ratio);
  drawSlice(inner, { ...slice, trials: [], best: [-1, -1] }, range, Math.round(side));
  c.drawImage(inner, x, y, side, side);
  for (const t of slice.trials) dot(c, x + t.x * side, y + (1 - t.y) * side, t);   // also those on the edge, whole
  for (const [colour, width] of [["#fff", 4], ["#111", 1.8]]) {
    c.strokeStyle = colour; c.lineWidth = width;
    cross(c, x + slice.best[0] * side, y + (1 - slice.best[1]) * side);
  }
  for (const [colour, width] of [["#fff", 6], ["#d1495b", 3]]) {
    c.strokeStyle = colour; c.lineWidth = width;
    c.beginPath(); c.arc(x + across.hidden_unit * side, y + (1 - up.hidden_unit) * side, 9, 0, 7); c.stroke();
  }
  c.fillStyle = "#1d2733"; c.font = "14px system-ui, sans-serif"; c.textAlign = "center";
  c.fillText(`at ${slice.held.replace(" ", " = ")}`, x + side / 2, y - 8);
  const value = (p, u) => Number((p.scale === "log" ? p.low * (p.high / p.low) ** u : p.low + (p.high - p.low) * u).toPrecision(2));
  for (const u of [0, 0.5, 1]) {
    c.textAlign = u === 0 ? "left" : u === 1 ? "right" : "center";
    c.fillText(value(across, u), x + u * side, y + side + 18);
    c.textAlign = "right";
    c.fillText(value(up, u), x - 6, y + (1 - u) * side + (u === 1 ? 11 : u === 0 ? 0 : 5));
  }
  const label = (p) => p.name + (p.unit ? ` (${p.unit})` : "");
  c.font = "600 14px system-ui, sans-serif"; c.textAlign = "center";
  c.fillText(label(across), x + side / 2, y + side + 40);
  c.translate(x - 48, y + side / 2); c.rotate(-Math.PI / 2); c.fillText(label(up), 0, 0);
}
