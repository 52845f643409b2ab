// Tables that sort by a click on a heading and filter by words.
(() => {
"use strict";
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
}
window.addEventListener("DOMContentLoaded", () => document.querySelectorAll("table.sortable").forEach(table => {
  table.querySelectorAll("thead th").forEach((head, column) => {
    const button = document.createElement("button");
    button.type = "button"; button.append(...head.childNodes); head.append(button);
    button.addEventListener("click", () => sort(table, column, head));
  });
  const filter = document.createElement("label"), input = document.createElement("input");
  filter.className = "filter"; filter.append("Filter: ", input); input.type = "search";
  input.addEventListener("input", () => {
    const words = input.value.toLowerCase().split(/\s+/).filter(Boolean);
    for (const row of table.tBodies[0].rows) row.hidden = !words.every(w => row.textContent.toLowerCase().includes(w));
  });
  table.parentElement.before(filter);
}));
})();
