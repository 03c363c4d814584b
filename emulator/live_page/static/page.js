"use strict";
// One WebSocket brings pictures (binary) and tables (JSON); see messages.py. Nothing else is loaded.

import * as picture from "./picture.js";
import {TimeAxis} from "./axis.js";
import {showChanges} from "./changes.js";
import {showFaults} from "./faults.js";
import {Repeats} from "./repeats.js";

const $ = (id) => document.getElementById(id);
const PARTS = {
  read_out: ["read out", "#009e73"], pending: ["pending", "#f0e442"], lost_at_readout: ["lost at the read-out", "#e69f00"],
  lost_in_pixel: ["lost in the pixel", "#56b4e9"], delivered: ["delivered", "#009e73"], on_the_way: ["on the way", "#f0e442"],
  no_host: ["no host was reading", "#5a6674"], dropped_in_device: ["dropped in the camera", "#cc79a7"], dropped: ["dropped by the link", "#d55e00"],
};
const SLIDERS = {
  threshold_on: ["ON threshold", "ln", 0.03, 1.5], threshold_off: ["OFF threshold", "ln", 0.03, 1.5],
  leak_hz: ["leak", "Hz", 0.01, 50], refractory_us: ["refractory period", "us", 1, 50000],
  corner_max_hz: ["bandwidth", "Hz", 3, 30000],
};
let socket, received = 0, about = null, status = null, first = null, retry_ms = 500, over = false;

// ---- connection ----

function connect() {
  const token = new URLSearchParams(location.hash.slice(1)).get("token") || "";
  socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/live`);
  socket.binaryType = "arraybuffer";
  received = 0;
  socket.onopen = () => socket.send(JSON.stringify({do: "hello", token}));
  socket.onmessage = (event) => {
    received += 1;
    try {
      if (typeof event.data === "string") hear(JSON.parse(event.data));
      else picture.take(event.data);
    } catch (error) {
      if (!(error instanceof SyntaxError)) throw error;
      picture.damage();
    } finally { send({do: "seen", number: received}); }
  };
  socket.onclose = (event) => {
    if (over) return;
    state(event.code === 4401 ? "wrong token" : event.reason || "not connected", "over");
    if (event.code !== 4401) setTimeout(connect, retry_ms = Math.min(retry_ms * 1.5, 5000));
  };
}

picture.onRequest(send);

function send(message) { if (socket.readyState === 1) socket.send(JSON.stringify(message)); }

function hear(message) {
  if (message.kind === "about") begin(message);
  else if (message.kind === "history") axis.restore(message);
  else if (message.kind === "answer" && message.pixel) picture.thresholds(message.pixel, message.thresholds);
  else if (message.kind === "answer") $("answer").textContent = message.did || message.error;
  else if (message.kind === "ended") {
    over = !status || status.next_seed === null;  // else the next run has the same address
    state(over ? "the run has ended" : "starting again", "over");
  }
  else { status = {...status, ...message}; if (message.kind === "status") figures(); showChanges($("changes"), $("changes-note"), status, send);
    repeats.renew({...status, totals: status.totals && {...status.totals, changes: status.changes_made}}, $("health").textContent);
    controls();
  }
}

function state(text, kind) { $("state").textContent = text; $("state").className = kind; }

function begin(message) {
  if (about && about.run !== message.run) axis.another();  // stream time begins again
  about = message; first = null; status = null; retry_ms = 500;
  axis.restore(about);
  picture.about(about);
  repeats.begin(about);
  $("name").textContent = document.title = about.name;
  $("title").textContent = about.title;
  state("live", "live");
  showFaults($("faults"), about.links, send);
}

// ---- figures ----

export const axis = new TimeAxis($("axis"), $("axis-at"), si, duration);
for (const input of document.querySelectorAll("input[name=span]")) input.onchange = () => axis.show(Number(input.value));
const repeats = new Repeats({seed: $("seed"), go: $("again-go"), stop: $("stop"), why: $("again-why"), table: $("compare")}, {si, duration}, send);
let cpu = null;

function figures() {
  const late = status.lateness, latency = status.axis.points.at(-1) || {p50: null}, now = performance.now() / 1000;
  const load = cpu && now > cpu.now ? (status.page_cpu_s - cpu.used) / (now - cpu.now) : 0;
  if (!cpu || now - cpu.now > 5) cpu = {now, used: status.page_cpu_s, load: cpu ? load : null};
  numbers({
    "stream time": [`${status.t_s.toFixed(2)} s`, `${status.frames} light frames drawn`],
    "real-time factor": [status.real_time_factor.toFixed(2), `${ratio(status.t_s, status.wall_s).toFixed(2)} since the start`],
    "event rate": [`${si(status.events_per_s)}/s`, `${si(ratio(status.totals.read_out, status.t_s))}/s since the start`],
    latency: latency.p50 === null ? ["none", "no event has left a link"] : [duration(latency.p50), `99 %: ${duration(latency.p99)}, since the start`],
    "steps late": [`${status.steps_late} of ${status.steps}`, `${late.frames_late} of ${status.frames} since the start`],
    "worst lateness": [duration(late.worst_gap_us), "since the start"],
    "longer steps": [late.steps_stretched, "since the start"],
    viewers: [status.viewers, cpu.load === null ? "" : `page: ${(100 * cpu.load).toFixed(1)} % of a core`],
  });
  axis.renew(status);
  ledger(); links(); health();
}

// State of the run: the steps of the last second; and the rules of its verdict that are broken since the start.
function health() {
  const late = status.lateness, {late_ms, late_share} = about.limits, paced = about.pace === "realtime" && late_ms > 0;
  const broken = Object.entries(status.links).filter(([, link]) => link.error).map(([name]) => `link ${name}`);
  if (document.querySelector("#ledger [data-sound=false]")) broken.push("ledger");
  if (paced && late.worst_gap_us > 1e3 * late_ms) broken.push(`worst step ${duration(late.worst_gap_us)} late`);
  if (paced && late.frames_late > late_share * status.frames) broken.push(`${share(late.frames_late, status.frames)} of the steps late`);
  const {steps, steps_late} = status;
  mark("now", paced ? `now: ${steps_late ? `${steps_late} of ${steps} steps late` : "in time"}` : "", steps_late ? "late" : "good");
  mark("health", `since the start: ${broken.length ? `bad: ${broken.join(", ")}` : "good"}`, broken.length ? "bad" : "good");
}

function mark(id, text, kind) { put($(id), text); $(id).className = kind; }

function ratio(part, whole) { return whole > 0 ? part / whole : 0; }

function share(part, whole) { return `${Number((100 * part / Math.max(whole, 1)).toPrecision(2))} %`; }

function duration(us) {
  for (const [unit, size] of [["s", 1e6], ["ms", 1e3]]) if (us >= size) return `${Number((us / size).toPrecision(3))} ${unit}`;
  return `${Math.round(us)} us`;
}

function numbers(table) {
  const list = $("numbers");
  if (!list.children.length) list.replaceChildren(...Object.keys(table).map((name) => {
    const box = document.createElement("div"), [dt, dd, note] = ["dt", "dd", "dd"].map((tag) => document.createElement(tag));
    dt.textContent = name; dd.dataset.name = name; note.className = "note"; box.append(dt, dd, note);
    return box;
  }));
  Object.values(table).forEach((texts, k) => texts.forEach((text, n) => { list.children[k].children[n + 1].textContent = text; }));
}

function si(value) {
  for (const [unit, size] of [["M", 1e6], ["k", 1e3]]) if (value >= size) return `${(value / size).toPrecision(3)} ${unit}`;
  return value.toFixed(0);
}

function ledger() {
  const tables = [["raised", status.ledger], ...Object.entries(status.ledger.links)];
  const box = $("ledger");
  if (box.children.length !== tables.length) box.replaceChildren(...tables.map(() => {
    const made = document.createElement("div");
    made.innerHTML = "<div class=\"head\"></div><div class=\"bar\"></div><div class=\"parts\"></div>";
    return made;
  }));
  tables.forEach(([name, {whole, parts}], k) => {
    const [head, bar, text] = box.children[k].children, entries = Object.entries(parts);
    const sum = entries.reduce((all, [, n]) => all + n, 0), sound = sum === whole && entries.every(([, n]) => n >= 0);
    head.textContent = `${name}: ${whole.toLocaleString()} ${sound ? "= the sum of its parts" : `BUT THE PARTS ARE ${sum}`}`;
    head.dataset.sound = sound;
    if (bar.children.length !== entries.length) {
      bar.replaceChildren(...entries.map(([part]) => { const d = document.createElement("div"); d.style.background = PARTS[part][1]; return d; }));
      text.replaceChildren(...entries.map(([part]) => {
        const s = document.createElement("span"), i = document.createElement("i");
        s.className = "part"; i.style.background = PARTS[part][1]; s.append(i, " ", document.createElement("span")); return s;
      }));
    }
    entries.forEach(([part, n], j) => {
      bar.children[j].style.width = `${100 * Math.max(n, 0) / Math.max(whole, 1)}%`;
      bar.children[j].style.flexBasis = bar.children[j].style.width;
      text.children[j].lastChild.textContent = `${PARTS[part][0]} ${n.toLocaleString()}`;
    });
  });
}

function links() {
  const box = $("links"), all = Object.entries(status.links);
  if (!all.length) box.textContent = "This rig has no link.";
  else if (box.children.length !== all.length) box.replaceChildren(...all.map(([name]) => {
    const row = document.createElement("div");
    row.className = "link";
    row.innerHTML = "<b></b> <span></span><div class=\"bad\"></div><div class=\"attach\"><code></code><button type=\"button\">copy</button></div>";
    const [head, , , attach] = row.children, [command, copy] = attach.children;
    head.textContent = name;
    copy.setAttribute("aria-label", `copy the command that attaches a host to ${name}`);
    copy.onclick = () => copied(command, copy);
    return row;
  }));
  all.forEach(([, link], k) => {
    const [, state, bad, attach] = box.children[k].children;
    put(state, `${link.state}${link.address && !link.state.includes(link.address) ? ` at ${link.address}` : ""}, ${link.faults} faults, ${link.edges} triggers`);
    put(bad, link.error || "");
    put(attach.firstChild, link.attach_command);
    attach.hidden = !link.attach_command;
  });
}

function put(element, text) { if (element.textContent !== text) element.textContent = text; }  // a selection stays

async function copied(command, button) {
  try { await navigator.clipboard.writeText(command.textContent); } catch {  // not at an address of another machine
    getSelection().selectAllChildren(command);
    document.execCommand("copy");
  }
  button.textContent = "copied";
  setTimeout(() => { button.textContent = "copy"; }, 2000);
}

// ---- controls ----

function controls() {
  $("pause").hidden = $("step").hidden = !status.can_pause;
  $("pause").textContent = status.paused ? "resume" : "pause";
  $("trigger").hidden = !status.can_trigger;
  if (!over) state(status.paused ? "paused" : "live", "live");
  const names = Object.keys(status.adjustable || {});
  $("sensor").hidden = !names.length;
  if (!first) { first = {...status.adjustable}; $("sliders").replaceChildren(...names.filter((name) => SLIDERS[name]).map(slider)); }
  for (const name of names) renew(name);
}

function slider(name) {
  const [text, , low, high] = SLIDERS[name], label = document.createElement("label"), input = document.createElement("input");
  label.className = "slider"; label.id = `row-${name}`;
  Object.assign(input, {type: "range", min: 0, max: 1, step: 0.002, id: `slider-${name}`});
  const ask = later((place) => send({do: "adjust", name, value: Number((low * (high / low) ** place).toPrecision(3))}));
  input.oninput = () => ask(input.value);  // now: `renew` may move the slider back before `later` sends
  label.append(text, input, document.createElement("output"));
  return label;
}

function renew(name) {
  const row = $(`row-${name}`);
  if (!row) return;
  const [, unit, low, high] = SLIDERS[name], value = status.adjustable[name], input = row.querySelector("input");
  if (document.activeElement !== input) input.value = Math.log(Math.max(value, low) / low) / Math.log(high / low);
  row.querySelector("output").textContent = `${value > 1e8 ? "no limit" : Number(value.toPrecision(3))} ${unit}`;
}

function later(act) {  // at most ten times a second, with the last value
  let waits = false, last;
  return (value) => { last = value; if (!waits) { waits = true; setTimeout(() => { waits = false; act(last); }, 100); } };
}

let recorder = null;

function video() {
  if (recorder) return recorder.stop();
  const parts = [];
  recorder = new MediaRecorder(picture.canvas().captureStream(25), {videoBitsPerSecond: 8e6});
  recorder.ondataavailable = (event) => parts.push(event.data);
  recorder.onstop = () => { recorder = null; $("video").textContent = "record video"; save(new Blob(parts, {type: "video/webm"}), "webm"); };
  recorder.start();
  $("video").textContent = "stop recording";
}

function save(blob, kind) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = `${about ? about.name : "evstim"}-${status ? status.t_s.toFixed(2) : 0}s.${kind}`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

const ACTS = {
  pause: () => send({do: status && status.paused ? "resume" : "pause"}), step: () => send({do: "step"}),
  trigger: () => send({do: "trigger"}), "picture-file": () => picture.canvas().toBlob((blob) => save(blob, "png")), video,
  full: () => document.fullscreenElement ? document.exitFullscreen() : $("show").requestFullscreen(),
  reset: () => { for (const [name, value] of Object.entries(first || {})) send({do: "adjust", name, value}); document.activeElement.blur(); },
};
for (const [id, act] of Object.entries(ACTS)) $(id).onclick = act;

const KEYS = {" ": "pause", ".": "step", t: "trigger", s: "picture-file", r: "video", f: "full"};
document.addEventListener("keydown", (event) => {
  if (event.target.closest("input:not([type=radio]):not([type=range]), select, dialog")) return;  // typed into a field
  if (event.ctrlKey || event.altKey || event.metaKey || ["BUTTON", "INPUT"].includes(event.target.tagName) && event.key === " ") return;
  if (event.key === "1" || event.key === "2") document.querySelectorAll("input[name=mode]")[event.key - 1].click();
  else if (KEYS[event.key] && !$(KEYS[event.key]).hidden) { event.preventDefault(); ACTS[KEYS[event.key]](); }
});

connect();
