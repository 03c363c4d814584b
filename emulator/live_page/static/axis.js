"use strict";
// One axis of stream time: events, latency, inertial rates, frames, triggers, faults and changes, one lane each.
// The cursor is a slider of the keyboard and of a screen reader; its text has all values at its time.

import {describe} from "./changes.js";

const LEFT = 86, BASE = 18, ROW = 15, MOST_ROWS = 3;
const TICKS = [0.2, 0.5, 1, 2, 5, 10, 20, 60, 120, 300, 600, 1800, 3600, 7200, 14400];

export class TimeAxis {
  constructor(canvas, readout, si, duration) {
    Object.assign(this, {canvas, readout, si, duration, points: [], frames: [], faults: [], changes: [], span: 60, at: null, status: null, before: []});
    canvas.onpointermove = (event) => this.point(this.time(event.offsetX));
    canvas.onpointerdown = (event) => this.point(this.time(event.offsetX));
    canvas.onpointerleave = () => { if (document.activeElement !== canvas) this.point(null); };
    canvas.onkeydown = (event) => this.key(event);
    canvas.onblur = () => this.point(null);
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  show(span) { this.span = span; this.draw(); }

  // Another run begins: the rates of the last one stay for comparison.
  another() { const before = this.points; this.clear(); this.before = before; }

  // What the server has since the start of the run, in place of what came so far: it joins older points.
  restore({points, frames_read}) { this.points = points; this.frames = frames_read; this.draw(); }

  clear() { this.points = []; this.frames = []; this.faults = []; this.changes = []; this.at = null; }

  renew(status) {
    const {axis} = status;
    let last = this.points.at(-1)?.t_s ?? -1;
    if (axis.points.length && axis.points.at(-1).t_s < last) { this.another(); last = -1; }
    const lastFrame = this.frames.at(-1)?.[3] ?? -1;
    this.points.push(...axis.points.filter((one) => one.t_s > last));
    this.frames.push(...axis.frames_read.filter((one) => one[3] > lastFrame));
    const known = new Map(this.faults.map((one) => [`${one.link} ${one.number} ${one.began_s}`, one]));
    for (const one of axis.faults) known.set(`${one.link} ${one.number} ${one.began_s}`, one);
    this.faults = [...known.values()].slice(-500);
    this.changes = status.changes || this.changes;
    this.status = status;
    this.draw();
  }

  // ---- time ----

  get until() { return this.points.at(-1)?.t_s ?? 0; }
  get from() { return Math.max(0, this.until - this.span); }
  get shown() { return Math.min(this.span, Math.max(this.until, 2)); }  // it grows to its length at the start
  x(t_s) { return LEFT + (t_s - this.from) / this.shown * (this.width - LEFT); }
  time(x) { return Math.min(this.until, Math.max(this.from, this.from + (x - LEFT) / (this.width - LEFT) * this.shown)); }

  key(event) {
    const steps = {ArrowLeft: -1, ArrowRight: 1, PageDown: -10, PageUp: 10}, now = this.at ?? this.until;
    if (event.key in steps) this.point(Math.min(this.until, Math.max(this.from, now + steps[event.key] * this.shown / 120)));
    else if (event.key === "Home") this.point(this.from);
    else if (event.key === "End" || event.key === "Escape") this.point(null);
    else return;
    event.preventDefault();
  }

  point(at) { this.at = at; this.draw(); }

  // ---- lanes ----

  lanes() {
    const {axis} = this.status, value = (name) => (one) => one[name], shown = this.points.filter((one) => one.t_s >= this.from - 1);
    const faults = rows(this.faults.filter((one) => (one.ended_s ?? this.until) >= this.from)
      .map((one) => ({from: one.began_s, until: one.ended_s ?? this.until, text: `${one.kind.replaceAll("_", " ")} on ${one.link}`})));
    const linked = Object.keys(this.status.links).length;
    return [
      {name: "events", unit: "1/s", high: 64, points: shown, lines: [value("rate")], colours: ["s1"], fill: true, text: (v) => this.si(v), reason: "no event yet"},
      {name: "latency", unit: "", high: 56, points: shown, lines: [value("p50"), value("p99")], names: ["p50", "p99"], colours: ["s1", "s2"], text: (v) => this.duration(v), reason: linked ? "no event has left a link yet" : "this rig has no link"},
      {name: "IMU", unit: "deg/s", high: 56, points: shown, lines: [0, 1, 2].map((k) => (one) => one.imu && one.imu[k]), names: ["x", "y", "z"], colours: ["s1", "s2", "s3"], signed: true, text: (v) => String(v),
        reason: axis.has_imu ? "no host has switched the inertial unit on" : "this camera has no inertial unit"},
      {name: "frames", high: 20, bars: this.frames.map(([start, from, until, end]) => ({from: start, until: end, inner: [from, until]})), colour: "s2",
        reason: axis.has_frames ? "no host has switched frames on" : "this camera reads no frames"},
      {name: "triggers", high: 20, marks: shown.filter((one) => one.edges).map((one) => ({t_s: one.t_s, count: one.edges})), colour: "s3", reason: "no trigger yet"},
      {name: "faults", high: 10 + ROW * Math.max(1, ...faults.map((one) => one.row + 1)), bars: faults, colour: "bad", reason: "no fault yet"},
      {name: "changes", high: 24, marks: this.changes.map((one) => ({t_s: one.t_s, text: describe(one).split(":")[0]})), colour: "s4", diamond: true, reason: "no change from outside yet"},
    ];
  }

  draw() {
    const {canvas} = this, scale = devicePixelRatio || 1;
    if (!this.status || !canvas.clientWidth) return;
    this.width = canvas.clientWidth;
    const lanes = this.lanes().map((lane) => ({...lane, empty: this.isEmpty(lane)}));
    for (const lane of lanes) if (lane.empty) lane.high = Math.min(lane.high, 24);
    const height = lanes.reduce((sum, lane) => sum + lane.high + 10, 0) + BASE;
    canvas.style.height = `${height}px`;
    [canvas.width, canvas.height] = [Math.round(this.width * scale), Math.round(height * scale)];
    const pen = this.pen = canvas.getContext("2d");
    pen.scale(scale, scale);
    pen.font = "12px system-ui, sans-serif"; pen.textBaseline = "middle";
    this.colours = Object.fromEntries(["text", "dim", "line", "s1", "s2", "s3", "s4", "bad", "card"].map((name) => [name, colourOf(canvas, name)]));
    this.ticks(height);
    let top = 4;
    for (const lane of lanes) { this.lane(lane, top); top += lane.high + 10; }
    this.cursor(height);
  }

  isEmpty(lane) {
    if (lane.lines) return !lane.points.some((one) => lane.lines.some((line) => line(one) !== null && line(one) !== undefined));
    return !(lane.bars || lane.marks).length;
  }

  ticks(height) {
    const {pen, colours} = this, most = Math.max(2, (this.width - LEFT) / 70), step = TICKS.find((one) => this.shown / one <= most) || 86400;
    pen.textAlign = "center";
    for (let k = Math.ceil(this.from / step); k * step <= this.until; k += 1) {
      const t = Number((k * step).toFixed(1));
      const x = this.x(t);
      pen.strokeStyle = colours.line; pen.lineWidth = 1;
      pen.beginPath(); pen.moveTo(Math.round(x) + 0.5, 0); pen.lineTo(Math.round(x) + 0.5, height - BASE); pen.stroke();
      pen.fillStyle = colours.dim;
      if (x > LEFT + 12 && x < this.width - 14) pen.fillText(`${t} s`, x, height - BASE / 2);
    }
  }

  lane(lane, top) {
    const {pen, colours} = this, base = top + lane.high;
    pen.strokeStyle = colours.line; pen.lineWidth = 1;
    pen.beginPath(); pen.moveTo(LEFT, base + 0.5); pen.lineTo(this.width, base + 0.5); pen.stroke();
    pen.textAlign = "left"; pen.fillStyle = colours.text;
    pen.fillText(lane.name, 0, lane.lines && !lane.empty ? top + lane.high / 2 - (lane.unit ? 7 : 0) : top + lane.high / 2);
    pen.fillStyle = colours.dim;
    if (lane.unit && !lane.empty) pen.fillText(lane.unit, 0, top + lane.high / 2 + 8);
    pen.save();
    pen.beginPath(); pen.rect(LEFT, top - 4, this.width - LEFT, lane.high + 8); pen.clip();
    if (lane.empty) { pen.fillText(lane.reason, LEFT + 8, top + lane.high / 2); pen.restore(); return; }
    if (lane.bars) this.bars(lane, top);
    if (lane.marks) this.marks(lane, top);
    const limits = lane.lines ? this.lines(lane, top) : null;
    pen.restore();
    if (limits) {
      pen.textAlign = "right"; pen.fillStyle = colours.dim;
      pen.fillText(lane.text(limits[1]), LEFT - 6, top + 5);
      pen.fillText(limits[0] ? lane.text(limits[0]) : "0", LEFT - 6, base - 4);
    }
  }

  lines(lane, top) {
    const {pen, colours} = this, values = lane.points.flatMap((one) => lane.lines.map((line) => line(one))).filter((v) => v !== null && v !== undefined);
    const most = nice(Math.max(...values.map(Math.abs))), least = lane.signed ? -most : 0, base = top + lane.high;
    const y = (v) => base - (v - least) / (most - least) * lane.high;
    if (lane.fill && this.before.length) {
      pen.strokeStyle = colours.dim; pen.lineWidth = 1; pen.setLineDash([2, 3]); pen.beginPath();
      for (const one of this.before) if (one.t_s >= this.from && one.t_s <= this.until) pen.lineTo(this.x(one.t_s), y(one.rate));
      pen.stroke();
      pen.setLineDash([]); pen.textAlign = "left"; pen.fillStyle = colours.dim; pen.fillText("dotted: the run before", LEFT + 8, top + 5);
    }
    lane.lines.forEach((line, k) => {
      pen.strokeStyle = colours[lane.colours[k]]; pen.lineWidth = 1.6; pen.setLineDash(k ? [[5, 3], [2, 3]][k - 1] : []);
      pen.beginPath();
      let last = null;
      for (const one of lane.points) {
        const v = line(one);
        if (v === null || v === undefined) { last = null; continue; }
        const x = this.x(one.t_s);
        if (last === null) pen.moveTo(x, y(v)); else pen.lineTo(x, y(v));
        last = x;
      }
      pen.stroke();
      if (lane.fill && lane.points.length > 1) {
        pen.lineTo(this.x(lane.points.at(-1).t_s), base); pen.lineTo(this.x(lane.points[0].t_s), base);
        pen.globalAlpha = 0.18; pen.fillStyle = pen.strokeStyle; pen.fill(); pen.globalAlpha = 1;
      }
    });
    pen.setLineDash([]);
    (lane.names || []).reduce((x, name, k) => {
      pen.textAlign = "left"; pen.fillStyle = colours[lane.colours[k]];
      pen.fillText(name, x, top + 5);
      return x + pen.measureText(name).width + 10;
    }, LEFT + 8);
    return [least, most];
  }

  bars(lane, top) {
    const {pen, colours} = this;
    for (const bar of lane.bars) {
      if (bar.until < this.from) continue;
      const x = this.x(bar.from), wide = Math.max(bar.inner ? 1 : 3, this.x(bar.until) - x), middle = top + 12 + ROW * (bar.row || 0);
      pen.fillStyle = colours[lane.colour];
      pen.globalAlpha = bar.inner ? 0.4 : 1;
      pen.fillRect(x, middle - 6, wide, 12);
      pen.globalAlpha = 1;
      if (bar.inner) pen.fillRect(this.x(bar.inner[0]), middle - 6, Math.max(1, this.x(bar.inner[1]) - this.x(bar.inner[0])), 12);
      if (bar.text) this.label(bar.text, x + wide + 5, middle, Math.min(...lane.bars.filter((one) => one.row === bar.row && one.from > bar.from).map((one) => this.x(one.from)), this.width), x);
    }
  }

  marks(lane, top) {
    const {pen, colours} = this, middle = top + lane.high / 2, shown = lane.marks.filter((mark) => mark.t_s >= this.from).sort((a, b) => a.t_s - b.t_s);
    shown.forEach((mark, k) => {
      const x = this.x(mark.t_s);
      pen.fillStyle = colours[lane.colour];
      if (lane.diamond) { pen.beginPath(); pen.moveTo(x, middle - 6); pen.lineTo(x + 6, middle); pen.lineTo(x, middle + 6); pen.lineTo(x - 6, middle); pen.fill(); }
      else pen.fillRect(x - 1, middle - 7, 2, 14);
      if (mark.text) this.label(mark.text, x + 10, middle, Math.min(this.width, k + 1 < shown.length ? this.x(shown[k + 1].t_s) - 8 : this.width));
    });
  }

  // A text where there is room for it, behind its bar or in it.
  label(text, x, y, until, within = Infinity) {
    const {pen} = this, wide = pen.measureText(text).width, start = Math.max(within, LEFT) + 5;
    pen.textAlign = "left";
    if (x + wide < until && x > LEFT) { pen.fillStyle = this.colours.text; pen.fillText(text, x, y); }
    else if (start + wide < x - 8) { pen.fillStyle = this.colours.card; pen.fillText(text, start, y + 0.5); }
  }

  // ---- cursor ----

  cursor(height) {
    const at = this.at === null ? this.until : Math.max(this.at, this.from), {canvas, pen} = this;
    if (this.at !== null) {
      pen.strokeStyle = this.colours.text; pen.lineWidth = 1;
      pen.beginPath(); pen.moveTo(this.x(at), 0); pen.lineTo(this.x(at), height - BASE); pen.stroke();
    }
    const text = this.values(at);
    if (this.readout.textContent !== text) this.readout.textContent = text;
    if (this.at !== null || !this.spoken || at - this.spoken > 2) {
      this.spoken = at;
      for (const [name, v] of [["min", this.from], ["max", this.until], ["now", at]]) canvas.setAttribute(`aria-value${name}`, v.toFixed(2));
      canvas.setAttribute("aria-valuetext", text);
    }
  }

  values(at) {
    const near = this.points.reduce((best, one) => Math.abs(one.t_s - at) < Math.abs((best?.t_s ?? -1e9) - at) ? one : best, null);
    if (!near) return "no value yet";
    const parts = [`${at.toFixed(2)} s`, `${this.si(near.rate)} events/s`], tolerance = this.shown / 200;
    if (near.p50 !== null) parts.push(`latency p50 ${this.duration(near.p50)}, p99 ${this.duration(near.p99)}`);
    if (near.imu) parts.push(`x ${near.imu[0]}, y ${near.imu[1]}, z ${near.imu[2]} deg/s at ${near.imu_hz.toFixed(0)} Hz`);
    const frame = this.frames.find(([start, , , end]) => start <= at && at <= end);
    if (frame) parts.push(`a frame, exposure ${this.duration((frame[2] - frame[1]) * 1e6)}`);
    if (near.edges) parts.push(`${near.edges} ${near.edges > 1 ? "triggers" : "trigger"}`);
    for (const one of this.faults) if (one.began_s <= at + tolerance && at - tolerance <= (one.ended_s ?? this.until)) parts.push(`fault ${one.kind.replaceAll("_", " ")} on ${one.link}`);
    if (this.at !== null) for (const one of this.changes) if (Math.abs(one.t_s - at) <= tolerance) parts.push(`${describe(one).split(":")[0]} (${one.by})`);
    return parts.join(" · ");
  }
}

function colourOf(canvas, name) { return getComputedStyle(canvas.parentElement.querySelector(`[data-colour=${name}]`)).color; }

// Bars at the same time in rows of their own, as far as there are rows.
function rows(bars) {
  const ends = [];
  for (const bar of bars.sort((a, b) => a.from - b.from)) {
    const free = ends.findIndex((end) => end <= bar.from);
    bar.row = free >= 0 ? free : Math.min(ends.length, MOST_ROWS - 1);
    ends[bar.row] = Math.max(bar.until, ends[bar.row] ?? 0);
  }
  return bars;
}

function nice(value) {
  if (!(value > 0)) return 1;
  const ten = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 2.5, 5, 10].map((k) => k * ten).find((one) => one >= value * 0.999);
}
