// Strips over time: a canvas and a legend each. Points come as the server keeps them, see engine.py (`Point`).
"use strict";

const WINDOW_S = 60;
const GUTTER = 34; // px at the left, for the numbers of the scale
const P = { time: 0, status: 1, q: 2, tx: 3, ty: 4, tz: 5, sx: 6, sy: 7, sz: 8, srx: 9, sry: 10, srz: 11,
            nx: 12, ny: 13, nz: 14, nrx: 15, nry: 16, nrz: 17 };
const MDEG = 180e3 / Math.PI;
const AXES = ["x", "y", "z"];

function median(values) {
  const sorted = [...values].sort((a, b) => a - b);
  return sorted.length ? sorted[sorted.length >> 1] : 0;
}

// Rotation vector (rad, camera axes) of q relative to r; unit quaternions w, x, y, z.
function turnBetween(q, r) {
  const [a, b, c, d] = q, [w, x, y, z] = [r[0], -r[1], -r[2], -r[3]];
  let p = [a * w - b * x - c * y - d * z, a * x + b * w + c * z - d * y, a * y - b * z + c * w + d * x, a * z + b * y - c * x + d * w];
  if (p[0] < 0) p = p.map((n) => -n);
  const sine = Math.hypot(p[1], p[2], p[3]);
  const scale = sine > 1e-12 ? 2 * Math.atan2(sine, p[0]) / sine : 2;
  return [p[1] * scale, p[2] * scale, p[3] * scale];
}

// With a minus sign as wide as the plus.
function fixed(value, digits) {
  return value.toFixed(digits).replace("-", "\u2212");
}

// Three to four digits, whatever the size.
function short(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  return fixed(value, size >= 100 ? 0 : size >= 10 ? 1 : size >= 1 ? 2 : 3);
}

const STRIPS = [
  { title: "Position", unit: "µm", series: (points) => {
    const there = points.filter((p) => p[P.tx] !== null);
    const middle = AXES.map((_, i) => median(there.map((p) => p[P.tx + i])));
    return AXES.map((axis, i) => ({ axis, name: axis, at: (p) => p[P.tx + i] === null ? null : 1e3 * (p[P.tx + i] - middle[i]) }));
  } },
  { title: "Rotation about", unit: "mdeg", series: (points) => {
    const first = points.find((p) => p[P.q] !== null);
    const turns = new Map(points.map((p) => [p, p[P.q] === null ? null : turnBetween(p[P.q], first[P.q])]));
    const middle = AXES.map((_, i) => median([...turns.values()].filter((t) => t).map((t) => t[i])));
    return AXES.map((axis, i) => ({ axis, name: axis, at: (p) => turns.get(p) ? MDEG * (turns.get(p)[i] - middle[i]) : null }));
  } },
  { title: "Deviation of the position, s (line), n (dots)", unit: "µm", log: true, wanted: true, series: () =>
    AXES.map((axis, i) => ({ axis, name: axis, at: (p) => p[P.sx + i] === null ? null : 1e3 * p[P.sx + i],
                             dots: (p) => p[P.nx + i] === null ? null : 1e3 * p[P.nx + i] })) },
  { title: "Deviation of the rotation, s (line), n (dots)", unit: "mdeg", log: true, series: () =>
    AXES.map((axis, i) => ({ axis, name: axis, at: (p) => p[P.srx + i] === null ? null : MDEG * p[P.srx + i],
                             dots: (p) => p[P.nrx + i] === null ? null : MDEG * p[P.nrx + i] })) },
];

class Strips {
  constructor(root) {
    this.points = [];
    this.wanted = null;
    this.views = STRIPS.map((strip) => {
      const box = document.createElement("div");
      box.className = "strip";
      const head = document.createElement("h3");
      const title = document.createElement("span"), range = document.createElement("span");
      title.textContent = strip.title;
      head.append(title, range);
      const canvas = document.createElement("canvas"), legend = document.createElement("ul");
      box.append(head, canvas, legend);
      root.append(box);
      return { strip, canvas, legend, range };
    });
  }

  set(points) { this.points = points; this.draw(); }

  add(point) {
    const last = this.points[this.points.length - 1];
    if (last && last[P.time] >= point[P.time]) return;
    this.points.push(point);
    while (this.points.length && this.points[0][P.time] < point[P.time] - 2 * WINDOW_S) this.points.shift();
    this.draw();
  }

  draw() {
    if (this.asked) return;
    this.asked = requestAnimationFrame(() => { this.asked = 0; this.views.forEach((view) => this.drawOne(view)); });
  }

  drawOne({ strip, canvas, legend, range }) {
    const style = getComputedStyle(document.documentElement), ratio = window.devicePixelRatio || 1;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    if (!width) return;
    if (canvas.width !== Math.round(width * ratio)) canvas.width = Math.round(width * ratio);
    if (canvas.height !== Math.round(height * ratio)) canvas.height = Math.round(height * ratio);
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    const last = this.points[this.points.length - 1];
    const end = last ? last[P.time] : 0;
    const points = this.points.filter((p) => p[P.time] > end - WINDOW_S);
    const lines = points.length ? strip.series(points) : AXES.map((axis) => ({ axis, name: axis, at: () => null }));
    const wanted = strip.wanted ? this.wanted : null;
    const values = lines.flatMap((line) => points.flatMap((p) => [line.at(p), line.dots ? line.dots(p) : null])).filter((v) => v !== null && (!strip.log || v > 0));
    if (wanted) values.push(wanted);
    let low = Math.min(...values), high = Math.max(...values);
    if (!values.length) { low = strip.log ? 0.1 : -1; high = 1; }
    if (strip.log) { low /= 1.3; high *= 1.3; } else { const room = 0.12 * (high - low) || 1; low -= room; high += room; }
    const scale = strip.log ? Math.log : (v) => v;
    const base = height - 6;
    const x = (time) => GUTTER + (width - GUTTER) * (1 - (end - time) / WINDOW_S);
    const y = (value) => 2 + (base - 4) * (1 - (scale(value) - scale(low)) / (scale(high) - scale(low)));
    const colour = (name) => resolved(style.getPropertyValue("--" + name), canvas);
    pen.font = "10px system-ui, sans-serif";
    pen.lineWidth = 1;
    pen.strokeStyle = colour("line");
    pen.fillStyle = colour("soft");
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    let written = -Infinity;
    for (const tick of ticks(low, high, strip.log).reverse()) { // from the top down
      const at = Math.round(y(tick)) + 0.5;
      pen.beginPath(); pen.moveTo(GUTTER, at); pen.lineTo(width, at); pen.stroke();
      if (at < written + 10) continue;
      pen.fillText(number(tick), GUTTER - 5, Math.max(6, at));
      written = at;
    }
    if (wanted) {
      pen.strokeStyle = colour("ink"); pen.setLineDash([4, 3]);
      pen.beginPath(); pen.moveTo(GUTTER, y(wanted)); pen.lineTo(width, y(wanted)); pen.stroke(); pen.setLineDash([]);
    }
    for (const line of lines) {
      pen.strokeStyle = pen.fillStyle = colour(line.axis);
      pen.lineWidth = 1.5;
      pen.beginPath();
      let open = false;
      for (const p of points) {
        const value = line.at(p);
        if (value === null || (strip.log && value <= 0)) { open = false; continue; }
        if (open) pen.lineTo(x(p[P.time]), y(value)); else { pen.moveTo(x(p[P.time]) - 1, y(value)); pen.lineTo(x(p[P.time]), y(value)); }
        open = true;
      }
      pen.stroke();
      if (line.dots) for (const p of points) { const v = line.dots(p); if (v > 0) pen.fillRect(x(p[P.time]) - 0.75, y(v) - 0.75, 1.5, 1.5); }
    }
    let before = null;
    for (const p of points) { // what became of each frame, along the bottom
      const left = Math.max(GUTTER, before === null ? x(p[P.time]) - 3 : x(before));
      pen.fillStyle = colour(p[P.status] === "ok" ? "good" : p[P.status] === "ambiguous" ? "fair" : "bad");
      pen.fillRect(left, height - 3, Math.max(1, x(p[P.time]) - left), 3);
      before = p[P.time];
    }
    range.textContent = wanted ? `dashes: wanted · ${strip.unit}` : strip.unit;
    const now = points[points.length - 1];
    legend.replaceChildren(...lines.map((line) => {
      const item = document.createElement("li"), name = document.createElement("b"), value = document.createElement("span");
      name.className = "ax-" + line.axis;
      name.textContent = line.name;
      value.textContent = now ? short(line.at(now)) : "–";
      item.append(name, value);
      return item;
    }));
  }
}

// Colours are light-dark() pairs: what a canvas takes is what they come to.
const colours = new Map();
function resolved(value, element) {
  const key = value + matchMedia("(prefers-color-scheme: dark)").matches + document.documentElement.dataset.theme;
  if (!colours.has(key)) {
    const probe = document.createElement("span");
    probe.style.color = value;
    element.parentElement.append(probe);
    colours.set(key, getComputedStyle(probe).color);
    probe.remove();
  }
  return colours.get(key);
}

function number(value) {
  return String(Number(value.toPrecision(3))).replace("-", "\u2212");
}

function ticks(low, high, log) {
  if (log) {
    const found = [];
    for (let power = Math.floor(Math.log10(low)); power <= Math.log10(high); power++)
      for (const digit of [1, 2, 5]) found.push(digit * 10 ** power);
    const inside = found.filter((v) => v > low && v < high);
    const decades = inside.filter((v) => Math.abs(Math.log10(v) % 1) < 1e-9);
    if (inside.length > 1) return inside.length > 4 && decades.length > 1 ? decades : inside.slice(0, 4);
  }
  // the largest round step of which two numbers are in sight, so that there is a scale
  const power = 10 ** Math.ceil(Math.log10(high - low));
  const step = [1, 0.5, 0.2, 0.1, 0.05].map((n) => n * power).find((n) => Math.floor(high / n) - Math.ceil(low / n) >= 1);
  const found = [];
  for (let at = Math.ceil(low / step) * step; at < high; at += step) found.push(Math.abs(at) < step / 1e6 ? 0 : at);
  return found;
}
