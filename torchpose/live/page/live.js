// The live page: server-sent events in, requests for the newest picture out. Nothing here is kept but the newest.
"use strict";

const $ = (id) => document.getElementById(id);
const SVG = "http://www.w3.org/2000/svg";
const DEG = 180 / Math.PI;
const KEPT = 40; // states, so that a picture finds the overlay of its own frame
const STALE_MS = 3000;
const strips = new Strips($("strips"));
const states = new Map();
let about = { width: 3, height: 2, markers: [] };
let newest = null, shown = -1, drawn = -1, fetching = false, arrived = 0, events = null, refused = "";

function element(tag, attributes = {}, text = null) {
  const made = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  if (text !== null) made.textContent = text;
  return made;
}

function cell(text, kind = "", level = null) {
  const made = document.createElement("td");
  made.className = kind;
  made.textContent = text;
  if (level) made.dataset.level = level;
  return made;
}

// ---- what comes in

function connect() {
  if (events) return;
  events = new EventSource("/api/events");
  events.addEventListener("history", (event) => { heard(); strips.set(JSON.parse(event.data).points); });
  events.addEventListener("alive", heard);
  events.addEventListener("frame", (event) => { heard(); take(JSON.parse(event.data)); });
  events.onerror = () => {
    pulse("bad", "no connection");
    if (events && events.readyState === EventSource.CLOSED) { disconnect(); setTimeout(connect, 2000); }
  };
}

function disconnect() {
  if (events) events.close();
  events = null;
}

let heardAt = 0;
function heard() { heardAt = performance.now(); }

function take(state) {
  if (newest === null || state.number !== newest.number) arrived = performance.now();
  newest = state;
  states.set(state.version, state);
  while (states.size > KEPT) states.delete(states.keys().next().value);
  show(state);
  if (state.seen && state.seen.point) strips.add(state.seen.point);
  if (shown > drawn && states.has(shown)) draw(states.get(shown));
  look();
}

async function look() {
  if (fetching || document.hidden || newest === null || !newest.seen || newest.version <= shown) return;
  if (!newest.seen.picture) { shown = newest.version; draw(newest); return; }
  fetching = true;
  try {
    const answer = await fetch("/api/picture");
    if (answer.status === 200) {
      const version = Number(answer.headers.get("x-version"));
      if (version > shown) await put(await answer.blob(), version);
    }
  } catch { /* the next frame asks again */ } finally { fetching = false; }
  if (newest.version > shown) setTimeout(look, 60);
}

async function put(blob, version) {
  const image = $("picture"), before = image.src, url = URL.createObjectURL(blob), next = new Image();
  next.src = url;
  await next.decode();
  image.src = url;
  image.hidden = false;
  $("nothing").hidden = true;
  if (before) URL.revokeObjectURL(before);
  shown = version;
  if (states.has(version)) draw(states.get(version));
}

// ---- the picture

function draw(state) {
  drawn = state.version;
  const seen = state.seen, overlay = $("overlay"), parts = [];
  overlay.setAttribute("viewBox", `-0.5 -0.5 ${about.width} ${about.height}`);
  const unit = about.width / Math.max(1, overlay.clientWidth); // px of the frame in one of the screen
  const on = (layer) => document.querySelector(`[data-layer=${layer}]`).getAttribute("aria-pressed") === "true";
  const ellipse = (kind, [cx, cy, a, b, theta]) => element("ellipse", {
    class: kind, cx, cy, rx: a, ry: b, transform: `rotate(${theta * DEG} ${cx} ${cy})` });
  for (const { id, center, outer, inner, blur } of seen.outlines) {
    if (on("rings")) {
      parts.push(ellipse("outer", outer));
      if (inner) parts.push(ellipse("inner", inner));
      const [u, v] = center, arm = 5 * unit;
      parts.push(element("path", { class: "cross", d: `M${u - arm} ${v}H${u + arm}M${u} ${v - arm}V${v + arm}` }));
    }
    const label = [on("ids") ? String(id) : "", on("blur") && blur !== null ? `${blur.toFixed(2)} px` : ""].filter(Boolean).join("  ");
    if (label) parts.push(element("text", { x: outer[0] + 0.72 * outer[2] + 3 * unit, y: outer[1] - 0.72 * outer[2] - 3 * unit, "font-size": 15 * unit }, label));
  }
  if (on("axes") && seen.axes) seen.axes.forEach((line, i) => {
    if (line.length < 2) return;
    parts.push(element("polyline", { class: `axis ${AXES[i]}`, points: line.map((p) => p.join()).join(" ") }));
    const [u, v] = line[line.length - 1];
    parts.push(element("text", { class: "name", x: u + 4 * unit, y: v + 4 * unit, "font-size": 13 * unit }, AXES[i]));
  });
  overlay.replaceChildren(...parts);
  $("frame").textContent = seen.row.frame;
  $("figure").dataset.version = state.version;
  $("figure").dataset.latencyMs = Math.round(Date.now() - 1e3 * seen.taken_s);
}

// ---- numbers

function show(state) {
  const seen = state.seen;
  showRecording(state.recording);
  $("counts").textContent = `${state.number} frames looked at, ${state.passed_over} passed over, ${state.viewers} ${state.viewers === 1 ? "viewer" : "viewers"}`;
  if (!seen) {
    if (state.fault) status("bad", "no frames", state.fault, "");
    return;
  }
  const { level, meaning, hint } = seen.status;
  if (state.fault) status("bad", "no frames", state.fault, "It is tried again every two seconds.");
  else status(level, seen.row.status.replaceAll("_", " "), meaning, hint);
  const found = seen.outlines.length;
  $("markers").textContent = `${found}/${about.markers.length}`;
  $("figure").classList.toggle("stale", Boolean(state.fault));
  showPose(seen.row);
  $("turn").replaceChildren(...seen.turn.map(turnLine));
  showAccuracy(seen.accuracy);
  $("rings").replaceChildren(...seen.rings.map(ringLine));
}

function status(level, word, meaning, hint) {
  $("status").dataset.level = level;
  for (const [id, text] of [["status-word", word], ["status-meaning", meaning], ["status-hint", hint]])
    if ($(id).textContent !== text) $(id).textContent = text;
}

function showPose(row) {
  const lines = [];
  for (const axis of AXES) lines.push([axis.toUpperCase(), axis, row["t" + axis], "mm", 4, row["s" + axis], row["n" + axis], 1e3, "µm"]);
  for (const axis of AXES) lines.push(["R" + axis.toUpperCase(), axis, row["r" + axis] === null ? null : row["r" + axis] * DEG, "°", 4, row["sr" + axis], row["nr" + axis], MDEG, "mdeg"]);
  $("pose").replaceChildren(...lines.map(([name, axis, value, unit, digits, all, noise, scale, small]) => {
    const line = document.createElement("tr");
    const deviation = (v) => v === null ? "–" : short(v * scale);
    line.append(cell(name, "ax-" + axis), cell(value === null ? "–" : fixed(value, digits), "value"), cell(unit, "unit"),
                cell(deviation(all), "num"), cell(small, "unit"), cell(deviation(noise), "num soft"), cell(small, "unit"));
    return line;
  }));
}

function turnLine(line) {
  const item = document.createElement("li");
  item.dataset.level = line.level;
  item.dataset.key = line.key;
  const name = document.createElement("span"), value = document.createElement("span"), unit = document.createElement("small");
  const gauge = document.createElement("div"), text = document.createElement("span");
  name.className = "name"; name.textContent = line.name;
  value.className = "value"; value.textContent = line.value || "–";
  unit.textContent = line.unit; value.append(unit);
  gauge.className = "gauge"; gauge.append(gaugeOf(line));
  text.className = "text"; text.textContent = line.text;
  item.append(name, value, gauge, text);
  return item;
}

function gaugeOf({ at, zone }) {
  const picture = element("svg", { "aria-hidden": "true" });
  picture.append(element("rect", { class: "track", x: 0, y: 2, width: "100%", height: 2, rx: 1 }),
                 element("rect", { class: "zone", x: `${100 * zone[0]}%`, y: 1, width: `${100 * (zone[1] - zone[0])}%`, height: 4, rx: 2 }));
  if (at !== null) picture.append(element("circle", { class: "at", cx: `${100 * at}%`, cy: 3, r: 5 }));
  return picture;
}

function showAccuracy(accuracy) {
  $("accuracy").dataset.level = accuracy.level;
  $("accuracy-axis").textContent = accuracy.axis ? `standard deviation along ${accuracy.axis.toUpperCase()}, the worst axis` : "";
  $("accuracy-text").textContent = accuracy.text;
  const rows = [["Now, all", accuracy.stated_um, "stated"], ["Now, noise", accuracy.repeat_um, "noise"],
                ["Sharp, well lit", accuracy.reachable_um, "could"], ["Wanted", accuracy.wanted_um, "wanted"]];
  const most = 1.15 * Math.max(...rows.map((row) => row[1] || 0));
  $("bars").replaceChildren(...rows.flatMap(([name, value, kind]) => {
    const title = document.createElement("dt"), track = document.createElement("div"), number = document.createElement("dd"), unit = document.createElement("small");
    title.textContent = name;
    track.className = "track";
    if (value) {
      const picture = element("svg", { "aria-hidden": "true" });
      picture.append(element("rect", { class: kind, width: `${100 * value / most}%`, height: 8, rx: 4 }));
      track.append(picture);
    }
    number.textContent = value ? short(value) : "–";
    unit.textContent = "µm";
    number.append(unit);
    return [title, track, number];
  }));
}

function ringLine(ring) {
  const line = document.createElement("tr"), share = (v) => v === null ? "–" : (100 * v).toFixed(0);
  const [least, most] = ring.blur_axes || [null, null];
  line.append(cell(ring.marker), cell(short(ring.blur)), cell(least === null ? "–" : `${least.toFixed(2)}–${most.toFixed(2)}`),
              cell(share(ring.dark)), cell(share(ring.light)),
              cell((100 * ring.clipped).toFixed(1), "", ring.clipped > 0.002 ? (ring.clipped > 0.05 ? "bad" : "fair") : null), cell(ring.outer_px.toFixed(0)));
  return line;
}

// ---- keeping

let said = "";
function showRecording(recording) {
  const button = $("record");
  button.setAttribute("aria-pressed", recording.on);
  button.querySelector("span").textContent = recording.on ? "Stop" : "Record";
  if (recording.on) {
    const left = recording.left_out ? `, ${recording.left_out} left out` : "";
    $("kept").textContent = `${recording.name}: ${recording.frames} frames${left}`;
    said = "";
  } else if (recording.name && !said) {
    const why = recording.fault ? ` It ended by itself: ${recording.fault}` : "";
    $("kept").textContent = `${recording.name}: ${recording.frames} frames kept.${why}`;
  }
}

async function ask(path, body) {
  const answer = await fetch(path, { method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(body) });
  const sent = (answer.headers.get("content-type") || "").startsWith("application/json") ? await answer.json() : {};
  if (!answer.ok) throw new Error(sent.error || `It was refused (${answer.status}).`);
  return sent;
}

async function press(button, work) {
  button.disabled = true;
  try { await work(); } catch (error) { said = error.message; $("kept").textContent = said; } finally { button.disabled = false; }
}

$("record").addEventListener("click", () => press($("record"), async () => {
  said = "";
  await ask("/api/recording", { on: $("record").getAttribute("aria-pressed") !== "true" });
}));
$("still").addEventListener("click", () => press($("still"), async () => {
  const { name } = await ask("/api/still", {});
  said = `${name} kept.`;
  $("kept").textContent = said;
}));

// ---- the page

for (const toggle of document.querySelectorAll(".toggle")) toggle.addEventListener("click", () => {
  toggle.setAttribute("aria-pressed", toggle.getAttribute("aria-pressed") !== "true");
  if (states.has(drawn)) draw(states.get(drawn));
});

$("theme").addEventListener("click", () => {
  const dark = (document.documentElement.dataset.theme || (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light")) === "dark";
  document.documentElement.dataset.theme = dark ? "light" : "dark";
  strips.draw();
});

function pulse(level, text) {
  $("pulse").dataset.level = level;
  if ($("pulse-text").textContent !== text) $("pulse-text").textContent = text;
}

setInterval(() => {
  const now = performance.now();
  if (!events) return;
  if (now - heardAt > STALE_MS) return pulse("bad", "no connection");
  if (!newest || !newest.seen) return pulse("fair", "no frame yet");
  const age = now - arrived;
  const wait = Math.max(STALE_MS, newest.rate ? 3e3 / newest.rate : 0);
  if (age > wait) return pulse("bad", `no new frame for ${(age / 1e3).toFixed(0)} s`);
  const took = 1e3 * (newest.seen.ready_s - newest.seen.taken_s);
  pulse("good", `${newest.rate ? newest.rate.toFixed(1) : "–"} frames/s · ${took.toFixed(0)} ms`);
}, 250);

document.addEventListener("visibilitychange", () => document.hidden ? disconnect() : connect());
addEventListener("resize", () => { strips.draw(); if (states.has(drawn)) draw(states.get(drawn)); });

fetch("/api/about").then((answer) => answer.json()).then((found) => {
  about = found;
  $("figure").style.aspectRatio = `${about.width} / ${about.height}`;
  $("about").textContent = `${about.target} · ${about.source} · ${about.width} × ${about.height} px`;
  $("version").textContent = `torchpose ${about.version}`;
  strips.wanted = about.wanted_um;
  showPose({ tx: null, ty: null, tz: null, rx: null, ry: null, rz: null, sx: null, sy: null, sz: null, srx: null, sry: null, srz: null, nx: null, ny: null, nz: null, nrx: null, nry: null, nrz: null });
  connect();
});
