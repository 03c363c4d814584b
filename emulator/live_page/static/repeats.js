"use strict";
// Start of the run again with another seed, its end, and the comparison with the run before.

export class Repeats {
  constructor(parts, text, send) {
    Object.assign(this, {...parts, ...text, send, before: null});
    parts.go.onclick = () => { if (parts.seed.reportValidity() && parts.seed.value !== "") send({do: "again", seed: Number(parts.seed.value)}); };
    parts.stop.onclick = () => this.end();
  }

  begin(about) {
    this.about = about;
    this.before = about.before || null;
    this.seed.value = about.seed + 1;
    this.table.hidden = !this.before;
  }

  end() {  // a second click within some seconds confirms it
    const {stop} = this;
    if (stop.dataset.armed) { this.send({do: "stop"}); return; }
    stop.dataset.armed = "1"; stop.textContent = "stop now";
    setTimeout(() => { delete stop.dataset.armed; stop.textContent = "stop"; }, 4000);
  }

  renew(status, health) {
    this.go.disabled = Boolean(status.no_repeat) || status.next_seed !== null;
    const why = status.no_repeat ? `Cannot start again: ${status.no_repeat}.` : status.next_seed !== null ? `Starts again with seed ${status.next_seed}.` : `This run has seed ${this.about.seed}.`;
    if (this.why.textContent !== why) this.why.textContent = why;
    if (this.before && status.totals) this.compare(status.totals, health);
  }

  compare(now, health) {
    const {before, si, duration} = this, rate = (one) => one.t_s > 0 ? `${si(one.read_out / one.t_s)}/s` : "", time = (us) => us === null || us === undefined ? "none" : duration(us);
    const rows = [["seed", before.seed, this.about.seed], ["stream time", `${before.t_s.toFixed(2)} s`, `${now.t_s.toFixed(2)} s`],
      ["events raised", before.raised.toLocaleString(), now.raised.toLocaleString()], ["events read out", before.read_out.toLocaleString(), now.read_out.toLocaleString()],
      ["events per second, mean", rate(before), rate(now)], ["steps late", `${before.frames_late} of ${before.frames}`, `${now.frames_late} of ${now.frames}`]];
    for (const [name, link] of Object.entries(now.links)) {
      const old = before.links[name];
      if (!old) continue;
      rows.push([`${name}: delivered`, old.delivered.toLocaleString(), link.delivered.toLocaleString()], [`${name}: dropped`, old.dropped.toLocaleString(), link.dropped.toLocaleString()],
        [`${name}: latency p50, p99`, `${time(old.p50)}, ${time(old.p99)}`, `${time(link.p50)}, ${time(link.p99)}`]);
    }
    rows.push(["changed from outside", before.changes, now.changes], ["verdict", before.verdict, `so far: ${health}`]);
    if (this.table.rows.length !== rows.length + 1) this.build(rows);
    rows.forEach((row, k) => row.forEach((text, n) => { const cell = this.table.rows[k + 1].cells[n]; if (cell.textContent !== String(text)) cell.textContent = text; }));
  }

  build(rows) {
    this.table.innerHTML = "<caption>Comparison with the run before</caption><thead><tr><th></th><th scope=\"col\">before</th><th scope=\"col\">now</th></tr></thead><tbody></tbody>";
    for (const [name] of rows) {
      const row = this.table.tBodies[0].insertRow(), head = document.createElement("th");
      head.scope = "row"; head.textContent = name;
      row.append(head); row.insertCell(); row.insertCell();
    }
  }
}
