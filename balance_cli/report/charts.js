// Charts of the page: zoom, pan, cursor with values, linked axes. Each is made when it is first seen.
(() => {
"use strict";
const charts = [], links = new Map(), MISSING = 65535;
const css = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const px = n => n * (parseFloat(css("--px")) || 1);  // larger on very wide screens
const digits = 6;  // of float32, which has seven
const text = v => v == null || !isFinite(v) ? "–" : v === 0 ? "0" : String(Number(v.toPrecision(digits))).replace("-", "−");

function bytes(code) {
  const raw = atob(code), out = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) out[i] = raw.charCodeAt(i);
  return out.buffer;
}
function decode(a) {
  if (a.u) {
    const [from, to, n] = a.u;
    return Float64Array.from({length: n}, (_, i) => from + (to - from) * i / (n - 1));
  }
  if (a.f !== undefined) return Array.from(new Float32Array(bytes(a.f)), v => isFinite(v) ? v : null);
  return Array.from(new Uint16Array(bytes(a.q)), q => q === MISSING ? null : a.g ? Math.exp(a.a + q * a.s) : a.a + q * a.s);
}
function theme(color) {  // black curves are drawn in the color of the text
  if (color === "#222222") return css("--ink");
  if (!matchMedia("(prefers-color-scheme: dark)").matches) return color;
  const parts = [1, 3, 5].map(i => parseInt(color.slice(i, i + 2), 16));  // lighter on a dark ground
  return `rgb(${parts.map(v => Math.round(v + (255 - v) * 0.4)).join(" ")})`;
}
function drawMarks(u, marks) {
  const {ctx, bbox} = u, k = devicePixelRatio;
  ctx.save();
  ctx.beginPath(); ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height); ctx.clip();
  ctx.strokeStyle = ctx.fillStyle = css("--soft");
  ctx.lineWidth = k * 0.8; ctx.setLineDash([4 * k, 4 * k]); ctx.font = `${px(10) * k}px sans-serif`;
  ctx.textAlign = "left"; ctx.textBaseline = "alphabetic";
  let free = 0;  // a label that would cover another is left out
  for (const [x, label] of marks) {
    const at = Math.round(u.valToPos(x, "x", true));
    if (at < bbox.left || at > bbox.left + bbox.width) continue;
    ctx.beginPath(); ctx.moveTo(at, bbox.top); ctx.lineTo(at, bbox.top + bbox.height); ctx.stroke();
    if (!label || at < free) continue;
    ctx.fillText(label, at + 3 * k, bbox.top + px(10) * k);
    free = at + 6 * k + ctx.measureText(label).width;
  }
  ctx.restore();
}
function drawBands(u, plot, get) {
  const {ctx, bbox} = u, x = u.data[0];
  ctx.save();
  ctx.beginPath(); ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height); ctx.clip();
  ctx.globalAlpha = 0.22;
  plot.traces.forEach((t, i) => {
    if (!t.b || !u.series[i + 1].show) return;
    const low = get(t.b[0]), high = get(t.b[1]), keep = [];
    for (let j = 0; j < x.length; j++) if (low[j] != null && high[j] != null) keep.push(j);
    const place = (v, edge) => plot.log && !(v > 0) ? edge : u.valToPos(v, "y", true);
    ctx.fillStyle = theme(t.c);
    ctx.beginPath();
    for (const j of keep) ctx.lineTo(u.valToPos(x[j], "x", true), place(high[j], bbox.top + bbox.height));
    for (const j of keep.reverse()) ctx.lineTo(u.valToPos(x[j], "x", true), place(low[j], bbox.top + bbox.height));
    ctx.closePath(); ctx.fill();
  });
  ctx.restore();
}
function tickNumbers(u, splits) {
  return splits.map(v => v == null ? "" : Math.abs(v) >= 1e5 || (v && Math.abs(v) < 1e-3) ? v.toExponential(0) : text(v));
}
function axis(label, log) {
  // uPlot takes an undefined option for a given one; its own logarithmic ticks need limits at powers of ten.
  const splits = log ? {splits: decades} : {};
  return {...(/^phase/.test(label) ? {incrs: [10, 30, 90, 180]} : {}), ...splits,
    label, labelSize: px(18), labelFont: `${px(12)}px sans-serif`, font: `${px(11)}px sans-serif`, stroke: () => css("--soft"),
    grid: {stroke: () => css("--line"), width: 1}, ticks: {stroke: () => css("--line"), width: 1},
    size: px(log === null ? 34 : 62), gap: 3, values: tickNumbers};
}
function decades(u, axis, low, high) {  // 1, or 1, 2 and 5 where there are few decades
  const factors = high / low < 100 ? [1, 2, 5] : [1], out = [];
  for (let p = Math.floor(Math.log10(low)); p <= Math.ceil(Math.log10(high)); p++)
    for (const f of factors) { const v = f * 10 ** p; if (v >= low && v <= high) out.push(v); }
  return out;
}
function range(plot, get) {
  if (plot.lim) return () => plot.lim;
  if (!plot.log) return (u, low, high) => {
    if (low == null) return [0, 1];
    const [from, to] = u.series[0].idxs || [0, u.data[0].length - 1];
    plot.traces.forEach((t, i) => {
      if (!t.b || !u.series[i + 1].show) return;
      const below = get(t.b[0]), above = get(t.b[1]);
      for (let j = from; j <= to; j++) {
        if (below[j] != null) low = Math.min(low, below[j]);
        if (above[j] != null) high = Math.max(high, above[j]);
      }
    });
    const spare = low === high ? Math.abs(low) * 0.01 || 1 : 0.05 * (high - low);
    return [low - spare, high + spare];
  };
  return (u, low, high) => low == null || !(high > 0) ? [0.1, 1] : [Math.max(low, high * 1e-6) / 1.2, high * 1.2];
}
function options(plot, width, chart, get) {
  const unit = /\[(.*)\]/.exec(plot.yl), suffix = unit ? ` ${unit[1]}` : "";
  return {width, height: px(plot.h), scales: {x: {time: false}, y: {distr: plot.log ? 3 : 1, range: range(plot, get)}},
    axes: [axis(plot.xl, null), axis(plot.yl, plot.log)],
    cursor: {drag: {x: true, y: true, uni: 24}, ...(chart.link ? {sync: {key: chart.link, scales: ["x", null]}} : {}),
      points: {size: 6}},
    legend: {live: true},
    series: [{label: plot.xl.replace(/ \[.*/, ""), value: (u, v) => v == null ? "–" : text(v) + ((/\[(.*)\]/.exec(plot.xl) || ["", ""])[1] ? ` ${/\[(.*)\]/.exec(plot.xl)[1]}` : "")},
      ...plot.traces.map(t => ({label: t.l, stroke: () => theme(t.c), width: t.p ? 0 : t.w, ...(t.d ? {dash: t.d} : {}), spanGaps: false,
        points: t.p ? {show: true, size: 6, fill: theme(t.c)} : {show: false},
        value: (u, v) => v == null ? "–" : text(v) + suffix}))],
    hooks: {drawAxes: [u => { drawMarks(u, plot.marks); drawBands(u, plot, get); }],
      setScale: [(u, key) => { if (key === "x") share(u, chart); }],
      setCursor: [u => announce(u, plot)]}};
}
let sharing = false;
function share(u, chart) {
  if (sharing || !chart.link) return;
  const {min, max} = u.scales.x;
  sharing = true;
  for (const other of links.get(chart.link) || [])
    for (const v of other.views) if (v !== u && (v.scales.x.min !== min || v.scales.x.max !== max)) v.setScale("x", {min, max});
  sharing = false;
}
function announce(u, plot) {
  if (document.activeElement !== u.root.parentNode || u.cursor.idx == null) return;
  const i = u.cursor.idx, words = plot.traces.filter((_, k) => u.series[k + 1].show).map(t => {
    const k = plot.traces.indexOf(t);
    return `${t.l} ${text(u.data[k + 1][i])}`;
  });
  u.root.parentNode.querySelector(".live").textContent = `${plot.xl} ${text(u.data[0][i])}: ${words.join(", ")}`;
}
function zoom(u, factor, shift) {
  const {min, max} = u.scales.x, x = u.data[0], middle = (min + max) / 2 + shift * (max - min);
  const half = Math.min((max - min) * factor, x[x.length - 1] - x[0]) / 2;
  const centre = Math.min(Math.max(middle, x[0] + half), x[x.length - 1] - half);
  u.setScale("x", {min: centre - half, max: centre + half});
}
function reset(u) { u.setScale("x", {min: u.data[0][0], max: u.data[0][u.data[0].length - 1]}); }
function keys(u, event) {
  const step = event.shiftKey ? 10 : 1, n = u.data[0].length;
  const actions = {"+": () => zoom(u, 0.5, 0), "-": () => zoom(u, 2, 0), "0": () => reset(u),
    PageUp: () => zoom(u, 1, -0.25), PageDown: () => zoom(u, 1, 0.25),
    ArrowLeft: () => move(u, -step, n), ArrowRight: () => move(u, step, n)};
  if (!actions[event.key] || event.target.closest("button, select, th")) return;
  event.preventDefault();
  actions[event.key]();
}
function move(u, step, n) {
  const i = Math.min(Math.max((u.cursor.idx ?? -1) + step, 0), n - 1);
  u.setCursor({left: u.valToPos(u.data[0][i], "x"), top: u.over.clientHeight / 2});
}
function pan(u) {  // shift and drag, or the middle button
  u.over.addEventListener("mousedown", down => {
    if (!down.shiftKey && down.button !== 1) return;
    down.preventDefault(); down.stopImmediatePropagation();
    const {min, max} = u.scales.x, scale = (max - min) / u.over.clientWidth;
    const onMove = e => { const d = (down.clientX - e.clientX) * scale; u.setScale("x", {min: min + d, max: max + d}); };
    const up = () => { document.removeEventListener("mousemove", onMove); document.removeEventListener("mouseup", up); };
    document.addEventListener("mousemove", onMove); document.addEventListener("mouseup", up);
  }, true);
  u.over.addEventListener("wheel", e => {
    if (!e.ctrlKey && !e.metaKey) return;
    e.preventDefault();
    const at = u.posToVal(e.offsetX, "x"), f = e.deltaY < 0 ? 0.8 : 1.25, {min, max} = u.scales.x;
    u.setScale("x", {min: at - (at - min) * f, max: at + (max - at) * f});
  }, {passive: false});
}
function legendKeys(u) {
  u.root.querySelectorAll(".u-legend .u-series").forEach((row, i) => {
    if (!i) return;
    const head = row.querySelector("th");
    head.tabIndex = 0; head.setAttribute("role", "button");
    const state = () => head.setAttribute("aria-pressed", String(u.series[i].show));
    state();
    head.addEventListener("click", () => setTimeout(state));
    head.addEventListener("keydown", e => { if (e.key === "Enter" || e.key === " ") { e.preventDefault(); head.click(); } });
  });
  const table = u.root.querySelector(".u-legend");
  table.setAttribute("role", "presentation");
}
function show(chart, group) {
  chart.views.splice(0).forEach(u => u.destroy());
  chart.place.replaceChildren();
  const boxes = chart.data.groups[group].plots.map(plot => {
    const box = document.createElement("div"), head = document.createElement("h4"), live = document.createElement("div");
    box.className = "axes"; box.tabIndex = 0; box.setAttribute("role", "group");
    box.setAttribute("aria-label", `${plot.title}. ${plot.yl} over ${plot.xl}. Arrow keys read values, plus and minus zoom.`);
    head.textContent = plot.title;
    live.className = "live"; live.setAttribute("aria-live", "polite");
    box.append(head, live);
    chart.place.append(box);
    return [plot, box];
  });
  const width = boxes[0][1].clientWidth;
  for (const [plot, box] of boxes) {
    const data = [chart.get(plot.x), ...plot.traces.map(t => chart.get(t.y))];
    const u = new uPlot(options(plot, width, chart, chart.get), data, box);
    box.addEventListener("keydown", e => keys(u, e));
    pan(u); legendKeys(u);
    chart.views.push(u);
  }
}
function build(figure) {
  const data = JSON.parse(figure.querySelector("script").textContent), made = new Map();
  const get = i => { if (!made.has(i)) made.set(i, decode(data.arrays[i])); return made.get(i); };
  const chart = {figure, data, get, link: data.link, views: [], place: figure.querySelector(".scripted .plots"), made};
  charts.push(chart);
  if (chart.link) links.set(chart.link, [...(links.get(chart.link) || []), chart]);
  const act = {in: u => zoom(u, 0.5, 0), out: u => zoom(u, 2, 0), left: u => zoom(u, 1, -0.25), right: u => zoom(u, 1, 0.25), all: reset};
  figure.querySelectorAll("[data-act]").forEach(b => b.addEventListener("click", () => chart.views.forEach(act[b.dataset.act])));
  const select = figure.querySelector(".tools select");
  if (select) select.addEventListener("change", () => show(chart, select.selectedIndex));
  const csv = figure.querySelector("[data-csv]");
  if (csv) csv.addEventListener("click", () => download(chart, figure.id, select ? select.selectedIndex : 0));
  show(chart, 0);
}
function download(chart, name, group) {
  const quote = s => `"${s.replaceAll('"', '""')}"`, lines = [];
  for (const plot of chart.data.groups[group].plots) {
    lines.push(quote(plot.title), [plot.xl, ...plot.traces.map(t => t.l)].map(quote).join(","));
    const columns = [chart.get(plot.x), ...plot.traces.map(t => chart.get(t.y))];
    for (let i = 0; i < columns[0].length; i++) lines.push(columns.map(c => c[i] ?? "").join(","));
  }
  const a = document.createElement("a");
  a.href = URL.createObjectURL(new Blob([lines.join("\n") + "\n"], {type: "text/csv"}));
  a.download = `${name}.csv`; a.click();
  setTimeout(() => URL.revokeObjectURL(a.href), 1000);
}
window.addEventListener("DOMContentLoaded", () => {
  if (matchMedia("(prefers-reduced-motion: reduce)").matches)
    document.querySelectorAll(".shapes svg").forEach(svg => svg.pauseAnimations());
  const seen = new IntersectionObserver(entries => entries.forEach(e => {
    if (e.isIntersecting) { seen.unobserve(e.target); build(e.target); }
  }), {rootMargin: "300px"});
  document.querySelectorAll("figure.chart").forEach(f => seen.observe(f));
  let waiting;
  window.addEventListener("resize", () => { clearTimeout(waiting); waiting = setTimeout(() => charts.forEach(c =>
    c.views.forEach(u => u.setSize({width: u.root.parentNode.clientWidth, height: u.height}))), 120); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => charts.forEach(c => c.views.forEach(u => u.redraw())));
  window.balanceCharts = charts;
  let onDemand = null;
  window.balanceShow = (place, plots, arrays) => {  // charts of values that another script has made
    if (onDemand) charts.splice(charts.indexOf(onDemand), 1);
    onDemand = {figure: place, data: {groups: [{plots}]}, get: i => arrays[i], link: "", views: [], place, made: new Map()};
    charts.push(onDemand);
    show(onDemand, 0);
  };
});
})();
