// Slices of the posterior mean on canvases: one for each pair of parameters.
"use strict";

const STOPS = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];

function colour(share) {
  const s = Math.min(1, Math.max(0, share)) * (STOPS.length - 1), i = Math.min(STOPS.length - 2, Math.floor(s)), f = s - i;
  return STOPS[i].map((v, k) => Math.round(v + f * (STOPS[i + 1][k] - v)));
}

function drawSlice(canvas, slice, range) {
  const n = slice.mean.length, side = 240, c = canvas.getContext("2d");
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
