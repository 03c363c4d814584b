"use strict";
// The picture: light and events of the last messages, drawn with the reader's view, exposure, time window and zoom.

const $ = (id) => document.getElementById(id);
const ON = [255, 140, 26], OFF = [46, 155, 255];  // far apart for colour-blind readers, and both light on a dark ground
const WINDOWS_MS = [10, 20, 50, 100, 200, 500, 1000, 2000];
const MOST_PICTURES = 50, MOST_PIXELS = 1 << 22, HEADER = 40, LARGEST_ZOOM = 32, STEEPEST_STOPS = 8;
const FULL_COUNT = 5;      // net events of a pixel in full colour
const ONE_EVENT = 0.35;    // colour of one net event
const FAINTEST = 0.15;     // colour of an event at the end of the window
const RENEWED_MS = 1000, REQUEST_MS = 100;  // thresholds of the pixel under the cursor
const LEVEL = 0.85;        // of white: the level of the percentile
const LIT = 1 / 512;       // of the reference: darker pixels are background and do not count for the exposure
const REFERENCE_SHARE = 0.9998;

const VALUES = new Float32Array(Uint32Array.from({length: 65536}, (_, code) => code << 15).buffer);  // see messages.py

const panes = {light: pane("pane-light", "light-picture"), events: pane("pane-events", "picture")};
let size = [0, 0], sensor = null, damaged = 0, codes, lastUs, polarity, sumOn, sumOff, past = [], untilUs = 0, every = 1;
let white = 0, held = false, shades = new Uint8Array(65536), shadesWhite = 0;
let zoom = {by: 1, left: 0, top: 0}, cursor = null;

function pane(id, canvas) {
  const box = $(id), drawn = $(canvas);
  return {box, canvas: drawn, pen: drawn.getContext("2d", {alpha: false}), cross: box.querySelector(".cross"), words: null};
}

// ---- messages ----

export function about(message) { sensor = message.size || null; past = []; if (sumOn) { sumOn.fill(0); sumOff.fill(0); lastUs.fill(-1e18); } }

// Show a picture; one that does not have the form in messages.py is counted, and changes nothing.
export function take(buffer) {
  const read = parsed(buffer);
  if (!read) return damage();
  fit(read.width, read.height);
  codes = read.codes; untilUs = read.until; every = read.every;
  const {place, last, count, from, until} = read;
  for (let k = 0; k < place.length; k++) {
    lastUs[place[k]] = from + (until - from) * Math.abs(last[k]) / 127;
    polarity[place[k]] = last[k] > 0 ? 1 : -1;
  }
  add(place, count, 1);
  if (until > from || place.length) past.push({place, count, from, until});
  forget();
  window.lastPictureUs = until;
  expose();
  draw();
}

// Count a damaged message.
export function damage() { damaged += 1; remarks(); }

function parsed(buffer) {
  if (buffer.byteLength < HEADER) return null;
  const head = new DataView(buffer), width = head.getUint16(8, true), height = head.getUint16(10, true);
  const n = width * height, active = head.getUint32(36, true), magic = String.fromCharCode(...new Uint8Array(buffer, 0, 4));
  if (magic !== "EVP2" || !n || n > MOST_PIXELS || active > n || buffer.byteLength !== HEADER + 2 * n + 6 * active) return null;
  const place = new Uint32Array(buffer, HEADER, active), planes = HEADER + 4 * active;
  if (place.some((at) => at >= n)) return null;
  return {
    width, height, place, every: head.getUint16(32, true),
    from: Number(head.getBigUint64(12, true)), until: Number(head.getBigUint64(20, true)),
    codes: new Uint16Array(buffer, planes, n), last: new Int8Array(buffer, planes + 2 * n, active),
    count: new Uint8Array(buffer, planes + 2 * n + active, active),
  };
}

function fit(width, height) {
  if (size[0] === width && size[1] === height) return;
  size = [width, height];
  const n = width * height;
  for (const each of Object.values(panes)) {
    [each.canvas.width, each.canvas.height] = size;
    each.image = each.pen.createImageData(width, height);
    each.words = new Uint32Array(each.image.data.buffer);
  }
  lastUs = new Float64Array(n).fill(-1e18); polarity = new Int8Array(n);
  sumOn = new Int32Array(n); sumOff = new Int32Array(n); past = [];
  document.documentElement.style.setProperty("--aspect", width / height);
  cursor = null; look(1, 0, 0);
}

function add(place, count, sign) {
  for (let k = 0; k < place.length; k++) {
    sumOn[place[k]] += sign * (count[k] & 15);
    sumOff[place[k]] += sign * (count[k] >> 4);
  }
}

function forget() {
  while (past.length > MOST_PICTURES || (past.length > 1 && past[0].until <= untilUs - windowUs())) {
    const {place, count} = past.shift();
    add(place, count, -1);
  }
}

function windowUs() { return 1e3 * WINDOWS_MS[Number($("window").value)]; }
function chosen(name) { return document.querySelector(`input[name=${name}]:checked`).value; }

// ---- exposure ----

// Bring white towards the chosen percentile of the lit pixels. Small changes are left out, so that the picture does not flicker.
function expose() {
  if (held && white) return;
  const goal = brightness();
  if (!goal) return;
  const off = white ? Math.log2(goal / white) : Infinity;
  if (Math.abs(off) > 3) white = goal;
  else if (Math.abs(off) > 0.04) white *= 2 ** (0.3 * off);
}

function brightness() {
  const bins = new Uint32Array(65536);
  for (let i = 0; i < codes.length; i++) bins[codes[i]] += 1;
  const reference = at(bins, 1, REFERENCE_SHARE), least = bins.findIndex((n, code) => code && VALUES[code] >= LIT * reference);
  return least < 0 || !reference ? 0 : at(bins, least, Number($("percentile").value) / 100) / LEVEL;
}

function at(bins, first, share) {
  let all = 0, sum = 0;
  for (let code = first; code < 65536; code++) all += bins[code];
  for (let code = first; code < 65536; code++) if ((sum += bins[code]) >= share * all && sum) return VALUES[code];
  return 0;
}

function stops() { return Number($("stops").value); }

function shade() {
  const top = white / 2 ** stops();
  if (top === shadesWhite) return;
  shadesWhite = top;
  for (let code = 0; code < 65536; code++) {
    const level = top > 0 ? Math.min(VALUES[code] / top, 1) : 0;
    shades[code] = 255 * (level <= 0.0031308 ? 12.92 * level : 1.055 * level ** (1 / 2.4) - 0.055);  // sRGB
  }
}

// ---- drawing ----

function draw() {
  if (!codes) return;
  shade();
  const view = chosen("view");
  if (view === "light" || view === "both") paint(panes.light, 1, false);
  if (view !== "light") paint(panes.events, view === "overlay" ? 0.75 : 0, true);
  remarks(); readout();
}

function paint({image, words, pen}, strength, withEvents) {
  const surface = chosen("mode") === "surface", span = windowUs();
  for (let i = 0; i < codes.length; i++) {
    const ground = strength * shades[codes[i]];
    let weight = 0, colour = ON;
    if (withEvents && surface) {
      const age = (untilUs - lastUs[i]) / span;
      if (age < 1) { weight = 1 - (1 - FAINTEST) * age; colour = polarity[i] > 0 ? ON : OFF; }
    } else if (withEvents) {
      const net = sumOn[i] - sumOff[i];
      if (net) { weight = Math.min(1, ONE_EVENT + (1 - ONE_EVENT) * (Math.abs(net) - 1) / (FULL_COUNT - 1)); colour = net > 0 ? ON : OFF; }
    }
    words[i] = 0xff000000 | (ground + weight * (colour[2] - ground)) << 16 | (ground + weight * (colour[1] - ground)) << 8
      | (ground + weight * (colour[0] - ground));
  }
  pen.putImageData(image, 0, 0);
}

function remarks() {
  const found = [];
  if (every > 1) found.push(`one event of ${every} is drawn`);
  if (damaged) found.push(`${damaged} damaged ${damaged > 1 ? "messages" : "message"} left out`);
  put("drawn", found.join(", "));
  put("white", white ? `= ${figure(white / 2 ** stops())}${held ? ", held" : ""}` : "");
}

function put(id, text) { if ($(id).textContent !== text) $(id).textContent = text; }
function figure(value) { return value === 0 ? "0" : value >= 1e-3 && value < 1e4 ? String(Number(value.toPrecision(3))) : value.toExponential(2); }
function time(us) { return us >= 1e6 ? `${(us / 1e6).toFixed(2)} s` : us >= 1e4 ? `${Math.round(us / 1e3)} ms` : `${(us / 1e3).toFixed(1)} ms`; }

function legend() {
  const span = windowUs(), surface = chosen("mode") === "surface", events = chosen("view") !== "light";
  $("legend").hidden = !events;
  $("legend").className = surface ? "surface" : "sum";
  put("window-text", time(span));
  put("legend-first", surface ? "now" : `${FULL_COUNT} or more`);
  put("legend-middle", surface ? time(span / 2) : `net events in ${time(span)}`);
  put("legend-last", surface ? `${time(span)} ago` : "1");
  $("window").setAttribute("aria-valuetext", time(span));
  panes.events.canvas.setAttribute("aria-label", chosen("view") === "overlay" ? "Events over the light of the scene" : "Events");
  const value = stops(), text = `${value > 0 ? "+" : value < 0 ? "\u2212" : "\u00b1"}${Math.abs(value).toFixed(1)} stops`;
  put("stops-text", text);
  $("stops").setAttribute("aria-valuetext", text);
}

// ---- values of the pixel under the cursor ----

function readout() {
  const shown = cursor && codes;
  $("screen").classList.toggle("read", Boolean(shown));
  if (!shown) return;
  const [x, y] = cursor, i = y * size[0] + x, by = sensor ? Math.ceil(sensor[0] / size[0]) : 1, span = past.length ? untilUs - past[0].from : 0;
  const age = untilUs - lastUs[i];
  put("read-pixel", by > 1 ? `${x * by}, ${y * by} (${by} \u00d7 ${by})` : `${x}, ${y}`);
  put("read-light", figure(VALUES[codes[i]]));
  requestThresholds([x * by, y * by]);
  put("read-events", `${sumOn[i]} ON, ${sumOff[i]} OFF in ${time(span)}`);
  put("read-last", age < 1e12 ? `${polarity[i] > 0 ? "ON" : "OFF"}, ${time(age)} ago` : "none yet");
}

// Thresholds differ from pixel to pixel; the run sends those of the pixel under the cursor, and again as sliders change them.
let send = () => {}, wanted = {at: null, sent_ms: 0}, waiting = 0;

export function onRequest(act) { send = act; }

function requestThresholds(at) {
  const now_ms = performance.now(), another = String(at) !== String(wanted.at);
  if (another) put("read-thresholds", "\u2026");
  else if (now_ms - wanted.sent_ms < RENEWED_MS) return;
  clearTimeout(waiting);
  if (now_ms - wanted.sent_ms < REQUEST_MS) { waiting = setTimeout(readout, REQUEST_MS); return; }
  wanted = {at, sent_ms: now_ms};
  send({do: "pixel", x: at[0], y: at[1]});
}

export function thresholds(pixel, values) {
  if (String(pixel) !== String(wanted.at)) return;
  put("read-thresholds", !values ? "not known" : values.length ? `ON ${figure(values[0])}, OFF ${figure(values[1])}` : "dead pixel");
}

let announcing = 0;

function announce() {  // for a screen reader, once the cursor rests
  clearTimeout(announcing);
  announcing = setTimeout(() => {
    if (cursor) put("spoken", ["pixel", "light", "thresholds", "events", "last"].map((name) => `${name} ${$(`read-${name}`).textContent}`).join("; "));
  }, 400);
}

function point(x, y) {
  if (!codes) return;
  cursor = [Math.min(Math.max(x, 0), size[0] - 1), Math.min(Math.max(y, 0), size[1] - 1)];
  marks(); readout();
}

function marks() {
  for (const {cross} of Object.values(panes)) {
    cross.hidden = !cursor;
    if (!cursor) continue;
    const part = [zoom.by / size[0], zoom.by / size[1]];
    cross.style.left = `${100 * ((cursor[0] / size[0] - zoom.left) * zoom.by)}%`;
    cross.style.top = `${100 * ((cursor[1] / size[1] - zoom.top) * zoom.by)}%`;
    cross.style.width = `${100 * part[0]}%`;
    cross.style.height = `${100 * part[1]}%`;
  }
}

// ---- zoom ----

// Show the part of the picture from (left, top), shares of it, `by` times as large.
function look(by, left, top) {
  by = Math.min(Math.max(by, 1), LARGEST_ZOOM);
  const most = 1 - 1 / by;
  zoom = {by, left: Math.min(Math.max(left, 0), most), top: Math.min(Math.max(top, 0), most)};
  for (const {canvas} of Object.values(panes)) canvas.style.transform = `translate(${-100 * zoom.left * by}%, ${-100 * zoom.top * by}%) scale(${by})`;
  $("screen").classList.toggle("zoomed", by > 1);
  put("zoom-text", `${by < 10 ? Number(by.toFixed(1)) : Math.round(by)}\u00d7`);
  $("zoom-out").disabled = $("zoom-fit").disabled = by === 1;
  $("zoom-in").disabled = by === LARGEST_ZOOM;
  marks();
}

// Change the zoom so that what lies at (across, down), shares of the pane, stays there.
function scale(factor, across = 0.5, down = 0.5) {
  const by = Math.min(Math.max(zoom.by * factor, 1), LARGEST_ZOOM);
  look(by, zoom.left + across / zoom.by - across / by, zoom.top + down / zoom.by - down / by);
}

function scaleAtCursor(factor) {
  const centre = cursor ? [(cursor[0] + 0.5) / size[0], (cursor[1] + 0.5) / size[1]] : null;
  if (!centre) return scale(factor);
  scale(factor, (centre[0] - zoom.left) * zoom.by, (centre[1] - zoom.top) * zoom.by);
}

function follow() {  // keep the cursor in sight
  const part = 1 / zoom.by, inside = (at, first) => Math.min(Math.max(first, at - 0.95 * part), at - 0.05 * part);
  look(zoom.by, inside((cursor[0] + 0.5) / size[0], zoom.left), inside((cursor[1] + 0.5) / size[1], zoom.top));
}

// ---- pointer and keys ----

const fingers = new Map();

function place(event, box) {
  const frame = box.getBoundingClientRect();
  return [(event.clientX - frame.left) / frame.width, (event.clientY - frame.top) / frame.height];
}

function hover(event, box) {
  const [across, down] = place(event, box);
  point(Math.floor((zoom.left + across / zoom.by) * size[0]), Math.floor((zoom.top + down / zoom.by) * size[1]));
}

function moved(event, box) {
  hover(event, box);
  const before = fingers.get(event.pointerId);
  if (!before) return;
  const now = place(event, box), other = [...fingers].find(([id]) => id !== event.pointerId)?.[1];
  if (other) {
    const length = (a) => Math.hypot(a[0] - other[0], a[1] - other[1]);
    scale(length(now) / Math.max(length(before), 0.01), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
  } else look(zoom.by, zoom.left - (now[0] - before[0]) / zoom.by, zoom.top - (now[1] - before[1]) / zoom.by);
  fingers.set(event.pointerId, now);
}

for (const {box} of Object.values(panes)) {
  box.addEventListener("pointerdown", (event) => { fingers.set(event.pointerId, place(event, box)); box.setPointerCapture(event.pointerId); hover(event, box); });
  box.addEventListener("pointermove", (event) => moved(event, box));
  for (const kind of ["pointerup", "pointercancel"]) box.addEventListener(kind, (event) => fingers.delete(event.pointerId));
  box.addEventListener("pointerleave", () => { if (document.activeElement !== $("screen")) { cursor = null; marks(); readout(); } });
  box.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && document.activeElement !== $("screen")) return;  // else the wheel scrolls the page
    event.preventDefault();
    scale(2 ** (-event.deltaY / 300), ...place(event, box));
  }, {passive: false});
  box.addEventListener("dblclick", (event) => scale(2, ...place(event, box)));
}

const ARROWS = {ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1]};

$("screen").addEventListener("keydown", (event) => {
  const arrow = ARROWS[event.key];
  if (event.ctrlKey || event.altKey || event.metaKey) return;
  if (arrow && size[0]) {
    const far = event.shiftKey ? 10 : 1, [x, y] = cursor || [size[0] >> 1, size[1] >> 1];
    point(x + far * arrow[0], y + far * arrow[1]);
    follow(); announce();
  } else if (event.key === "Escape" && cursor) { cursor = null; marks(); readout(); } else return;
  event.preventDefault();
});

const KEYS = {
  "+": () => scaleAtCursor(2), "=": () => scaleAtCursor(2), "-": () => scaleAtCursor(0.5), 0: () => look(1, 0, 0),
  b: () => turn(1), d: () => turn(-1), h: hold, v: nextView,
};

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.altKey || event.metaKey || ["SELECT", "TEXTAREA"].includes(event.target.tagName)) return;
  if (event.target.tagName === "INPUT" && !["radio", "range", "checkbox"].includes(event.target.type)) return;
  if (KEYS[event.key]) { event.preventDefault(); KEYS[event.key](); }
});

function turn(by) { $("stops").value = Math.min(Math.max(stops() + by / 2, -STEEPEST_STOPS), STEEPEST_STOPS); changed(); }
function hold() { held = !held; $("hold").setAttribute("aria-pressed", held); if (codes) { expose(); } changed(); }

function nextView() {
  const all = [...document.querySelectorAll("input[name=view]")];
  all[(all.findIndex((one) => one.checked) + 1) % all.length].checked = true;
  changed();
}

function changed() {
  $("screen").dataset.view = chosen("view");
  if (codes) { forget(); expose(); }
  legend(); draw();
}

for (const control of document.querySelectorAll("#show input, #show select")) control.addEventListener("input", changed);
$("zoom-in").onclick = KEYS["+"]; $("zoom-out").onclick = KEYS["-"]; $("zoom-fit").onclick = KEYS[0];
$("hold").onclick = hold;
$("expose").onclick = () => { $("stops").value = 0; held = false; $("hold").setAttribute("aria-pressed", false); white = 0; changed(); };

// ---- file ----

// Return the canvas for a file or a video: that of the chosen view.
export function canvas() { return chosen("view") === "light" ? panes.light.canvas : panes.events.canvas; }

// ---- theme ----

const THEMES = ["auto", "light", "dark"];

function theme(name) {
  document.documentElement.dataset.theme = name;
  $("theme").textContent = `theme: ${name}`;
  try { localStorage.setItem("evstim-theme", name); } catch { /* a browser may forbid it; the choice then lasts as long as the page */ }
}

function stored() { try { return localStorage.getItem("evstim-theme"); } catch { return null; } }

theme(THEMES.includes(stored()) ? stored() : "auto");
$("theme").onclick = () => theme(THEMES[(THEMES.indexOf(document.documentElement.dataset.theme) + 1) % THEMES.length]);

look(1, 0, 0);
changed();
