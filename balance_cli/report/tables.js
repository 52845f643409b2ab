// Tables that sort by a click on a heading and filter by words.
(() => {
"use strict";
const MOST_ROWS = 200;  // rows that are laid out at a time, as in chart.css
const value = cell => {
  const words = cell.textContent.trim().replace("−", "-"), number = parseFloat(words);
  return Number.isNaN(number) ? words.toLowerCase() : number;
};
function compare(a, b) {
  if (typeof a === typeof b) return a < b ? -1 : a > b ? 1 : 0;
  return typeof a === "number" ? -1 : 1;
}
function sort(table, column, head) {
  const down = head.getAttribute("aria-sort") === "ascending", body = table.tBodies[0];
  table.querySelectorAll("[aria-sort]").forEach(h => h.removeAttribute("aria-sort"));
  head.setAttribute("aria-sort", down ? "descending" : "ascending");
  const rows = [...body.rows].map(row => [value(row.cells[column]), row]);
  rows.sort((a, b) => (down ? -1 : 1) * compare(a[0], b[0]));
  body.append(...rows.map(([, row]) => row));
  table.dispatchEvent(new Event("sorted"));
}
window.addEventListener("DOMContentLoaded", () => document.querySelectorAll("table.sortable").forEach(table => {
  table.querySelectorAll("thead th").forEach((head, column) => {
    const button = document.createElement("button");
    button.type = "button"; button.append(...head.childNodes); head.append(button);
    button.addEventListener("click", () => sort(table, column, head));
  });
  const filter = document.createElement("label"), input = document.createElement("input");
  filter.className = "filter"; filter.append("Filter: ", input); input.type = "search";
  const rows = [...table.tBodies[0].rows], contents = rows.map(row => row.textContent.toLowerCase());
  const count = document.createElement("span");
  filter.append(" ", count);
  const all = document.createElement("button");
  all.type = "button"; all.textContent = "show all"; all.hidden = true;
  const tell = (shown, found) => {
    count.textContent = shown < rows.length ? `${shown} of ${found} rows shown` : "";
    all.hidden = shown >= found;
  };
  const apply = limit => {
    const words = input.value.toLowerCase().split(/\s+/).filter(Boolean);
    const kept = new Set(rows.filter((_, i) => words.every(w => contents[i].includes(w))));
    let shown = 0;
    for (const row of table.tBodies[0].rows) {
      const show = kept.has(row) && shown < limit;
      shown += show;
      row.hidden = !show;
    }
    table.classList.add("all");
    tell(shown, kept.size);
  };
  input.addEventListener("input", () => apply(MOST_ROWS));
  all.addEventListener("click", () => apply(Infinity));
  table.addEventListener("sorted", () => { if (table.classList.contains("all")) apply(MOST_ROWS); });
  tell(Math.min(rows.length, MOST_ROWS), rows.length);
  table.parentElement.before(filter, all);
}));
})();
