"use strict";
// List of what was changed from outside, the newest first, each with its stream time and its undo.

const NAMES = {threshold_on: "ON threshold", threshold_off: "OFF threshold", leak_hz: "leak", refractory_us: "refractory period", corner_max_hz: "bandwidth"};
const UNITS = {threshold_on: "", threshold_off: "", leak_hz: " Hz", refractory_us: " us", corner_max_hz: " Hz"};
const ENDED = {"the host has set it": "set by the host", "the cameras have received it": "received by the cameras, cannot be undone"};

export function showChanges(list, note, status, send) {
  const rows = status.changes || [];
  note.textContent = status.changes_made ? "The rig and its seed alone do not repeat this run; its summary lists these changes."
    : "Nothing has been changed by hand. Changes appear here with their stream time, and can be undone.";
  const shown = new Map([...list.children].map((item) => [Number(item.dataset.number), item]));
  const wanted = new Set(rows.map((row) => row.number));
  for (const [number, item] of shown) if (!wanted.has(number)) item.remove();
  for (const row of rows) {
    let item = shown.get(row.number);
    if (!item) {
      item = entry(row, send);
      item.t_s = row.t_s;
      list.insertBefore(item, [...list.children].find((other) => other.t_s <= row.t_s) || null);
    }
    renew(item, row);
  }
}

function entry(row, send) {
  const item = document.createElement("li");
  item.dataset.number = row.number;
  item.innerHTML = "<time></time><span class=\"what\"></span><span class=\"by\"></span><button type=\"button\">undo</button><span class=\"cannot\"></span>";
  item.querySelector("button").onclick = () => send({do: "undo", change: row.number});
  return item;
}

function renew(item, row) {
  const [time, what, by, undo, cannot] = item.children, text = describe(row);
  put(time, `${row.t_s.toFixed(3)} s`); put(what, text); put(by, row.by);
  undo.setAttribute("aria-label", `undo: ${text}`);
  const had = document.activeElement === undo;
  undo.hidden = Boolean(row.cannot);
  put(cannot, ENDED[row.cannot] || row.cannot);
  if (had && undo.hidden) { item.tabIndex = -1; item.focus(); }  // the keyboard stays in the list
}

function put(element, text) { if (element.textContent !== text) element.textContent = text; }

export function describe(row) {
  if (row.after !== null) return `${NAMES[row.what] || row.what} ${number(row.before)} → ${number(row.after)}${UNITS[row.what] || ""}${row.link ? ` (${row.link})` : ""}`;
  const fault = row.fault, text = row.what.replaceAll("_", " ").replace(/^fault /, "");
  const effect = !fault ? "" : `: ${fault.ended_us === null ? "active" : "over"}${fault.events_lost ? `, ${fault.events_lost.toLocaleString()} events lost` : fault.hits ? `, applied ${fault.hits} times` : ""}`;
  return `${text}${row.link ? ` on ${row.link}` : ""}${effect}`;
}

function number(value) { return value === null ? "?" : value > 1e8 ? "no limit" : String(Number(value.toPrecision(3))); }
