// The loads of one run of the index, on demand: a table of all harmonics, and the loads over azimuth.
(() => {
"use strict";
const MINUS = "−", STEP = 2;  // degrees
const text = (v, digits) => isFinite(v) ? v.toFixed(digits).replace("-", MINUS) : "–";
const make = (tag, words = "", name = "") => {
  const made = document.createElement(tag);
  made.textContent = words;
  if (name) made.className = name;
  return made;
};
function amounts(value, sigma) {  // to the second significant digit of sigma
  if (!isFinite(value)) return "–";
  if (!(sigma > 0)) return String(Number(value.toPrecision(6))).replace("-", MINUS);
  const digits = Math.min(Math.max(1 - Math.floor(Math.log10(sigma)), 0), 8);
  return `${text(value, digits)} ± ${text(sigma, digits)}`;
}
function unpack(data, run) {
  const raw = atob(run.d), bytes = Uint8Array.from(raw, c => c.charCodeAt(0)), v = new Float32Array(bytes.buffer);
  const count = run.c.length, rows = v.length / 4 / count;
  const at = (n, m) => {
    const i = 4 * (n * count + m), [c, s, dc, ds] = v.subarray(i, i + 4), size = Math.hypot(c, s);
    const spread = size > 0 ? Math.hypot(c * dc, s * ds) / size : Math.max(dc, ds);
    const flag = data.flags[parseInt(run.w.slice(2 * (n * count + m), 2 * (n * count + m) + 2), 36)];
    return {c, s, dc, ds, size, spread, flag};
  };
  return {rows, at};
}
function loadTable(run, {rows, at}) {
  const table = make("table"), head = table.createTHead().insertRow(), body = table.createTBody();
  head.append(make("th", "harmonic"));
  for (const [name, unit] of run.c) head.append(make("th", `${name} [${unit}]`));
  for (let n = 0; n < rows; n++) {
    const row = body.insertRow(), tones = run.f.length > 2;
    row.append(make("th", n === 0 ? "mean" : tones ? `${run.f[n]} Hz` : `${n}/rev`, "name"));
    run.c.forEach((_, m) => {
      const h = at(n, m), missing = h.flag.split("; ").includes("not measured"), cell = row.insertCell();
      cell.textContent = missing ? "–" : n ? amounts(h.size, h.spread) : amounts(h.c, h.dc);
      const phase = n && !missing ? `${text(Math.atan2(-h.s, h.c) * 180 / Math.PI, 1)}°` : "";
      cell.append(" ", make("small", [phase, h.flag].filter(Boolean).join(", ")));
      if (/redundancy|contradicted|not steady/.test(h.flag)) cell.className = "bad";
    });
  }
  return table;
}
function waves(run, {rows, at}) {
  const x = Array.from({length: 360 / STEP + 1}, (_, i) => i * STEP), arrays = [x], plots = [];
  run.c.forEach(([name, unit], m) => {
    const y = [], low = [], high = [], means = !at(0, m).flag.split("; ").includes("not measured");
    for (const psi of x) {
      let value = 0, variance = 0;
      for (let n = means ? 0 : 1; n < rows; n++) {
        const h = at(n, m), c = Math.cos(n * psi * Math.PI / 180), s = Math.sin(n * psi * Math.PI / 180);
        value += h.c * c + h.s * s;
        variance += (c * h.dc) ** 2 + (s * h.ds) ** 2;
      }
      y.push(isFinite(value) ? value : null); low.push(value - Math.sqrt(variance)); high.push(value + Math.sqrt(variance));
    }
    const i = arrays.push(y, low, high) - 3;
    plots.push({title: means ? name : `${name} without its mean`, x: 0, xl: "azimuth [°]", yl: `${name} [${unit}]`,
      log: false, lim: null, h: 200, marks: [], traces: [{l: name, c: "#0072b2", w: 1.4, y: i, b: [i + 1, i + 2]}]});
  });
  return [plots, arrays];
}
function open(index, place, row) {
  const {data, panel} = index, run = data.runs[place], values = unpack(data, run);
  index.figure.querySelectorAll("tr.shown").forEach(r => r.classList.remove("shown"));
  row.classList.add("shown");
  const head = make("h3", run.n), scroll = make("div", "", "scroll"), plots = make("div", "", "plots");
  head.tabIndex = -1;
  scroll.tabIndex = 0; scroll.setAttribute("role", "region"); scroll.setAttribute("aria-label", `Loads of ${run.n}`);
  scroll.append(loadTable(run, values));
  panel.hidden = false;
  panel.replaceChildren(head, make("p", data.sentences[run.s]), scroll, plots);
  if (run.f.length <= 2 && values.rows > 1) window.balanceShow(plots, ...waves(run, values));
  history.replaceState(null, "", `#run=${encodeURIComponent(run.n)}`);
  head.focus({preventScroll: true});
  panel.scrollIntoView({block: "nearest"});
}
window.addEventListener("DOMContentLoaded", () => document.querySelectorAll("figure.index").forEach(figure => {
  const data = JSON.parse(figure.querySelector(".run-data").textContent);
  const index = {figure, data, panel: figure.querySelector(".run-panel")};
  for (const row of figure.querySelectorAll("tbody tr")) {
    const head = row.cells[0], button = make("button", head.textContent.trim());
    button.type = "button";
    head.replaceChildren(button);
  }
  figure.querySelector("tbody").addEventListener("click", e => {
    const row = e.target.closest("tr");
    if (e.target.closest("button") && row) open(index, Number(row.dataset.run), row);
  });
  const wanted = /^#run=(.*)$/.exec(location.hash), name = wanted && decodeURIComponent(wanted[1]);
  const place = wanted ? data.runs.findIndex(run => run.n === name) : -1;
  if (place >= 0) open(index, place, figure.querySelector(`tr[data-run="${place}"]`));
}));
})();
