// Sorts, searches and filters the rows that are in the page already; nothing is fetched and nothing is kept.
"use strict";
{
  const body = document.querySelector("tbody");
  const search = document.querySelector("[type=search]");
  const chips = [...document.querySelectorAll(".chip")];
  const heads = [...document.querySelectorAll("thead th")];
  const said = document.querySelector("output");
  const names = new Intl.Collator("en", { numeric: true });

  const cases = [...(body ? body.rows : [])].map(row => ({
    row,
    name: row.dataset.case,
    rank: Number(row.dataset.rank),
    text: [0, 1, 3].map(index => row.cells[index].textContent).join(" ").toLowerCase(),
  }));

  // Rows that come back do so a screenful at a time: laying out thousands at once would hold up the next letter.
  const AT_ONCE = 250;
  let turn = 0;
  const reveal = (rows, mine) => {
    if (mine !== turn) return;
    for (const row of rows.splice(0, AT_ONCE)) row.hidden = false;
    if (rows.length) requestAnimationFrame(() => reveal(rows, mine));
  };

  const show = () => {
    const words = search.value.toLowerCase().split(/\s+/).filter(Boolean);
    const pressed = chips.filter(chip => chip.getAttribute("aria-pressed") === "true");
    const states = pressed.map(chip => chip.dataset.state).filter(Boolean);
    const unusual = pressed.some(chip => "unusual" in chip.dataset);
    const fits = ({ row, text }) => words.every(word => text.includes(word)) &&
      (!states.length || states.includes(row.dataset.state)) && (!unusual || "unusual" in row.dataset);
    const found = cases.filter(fits).map(one => one.row);
    const kept = new Set(found);
    for (const { row } of cases) if (!row.hidden && !kept.has(row)) row.hidden = true;
    said.textContent = found.length === cases.length ? "" : `${found.length} of ${cases.length} shown`;
    reveal(found.filter(row => row.hidden), ++turn);
  };

  const values = {
    case: () => () => 0,
    state: () => one => one.rank,
    number: column => one => Number.parseFloat(one.row.cells[column].textContent),
  };

  const sort = head => {
    const kind = head.dataset.by;
    const first = kind === "number" ? "descending" : "ascending";
    const other = first === "ascending" ? "descending" : "ascending";
    const way = head.getAttribute("aria-sort") === first ? other : first;
    for (const one of heads) if (one.dataset.by) one.setAttribute("aria-sort", one === head ? way : "none");
    const value = values[kind](heads.indexOf(head));
    for (const one of cases) one.value = value(one);
    const sign = way === "ascending" ? 1 : -1;
    // a number that is not there is last either way
    cases.sort((a, b) => Number.isNaN(a.value) - Number.isNaN(b.value) || sign * (a.value - b.value || 0) ||
      (kind === "case" ? sign : 1) * names.compare(a.name, b.name));
    body.append(...cases.map(one => one.row));
  };

  for (const one of document.querySelectorAll(":disabled")) one.disabled = false;
  for (const head of heads) {
    if (!head.dataset.by) continue;
    if (!head.hasAttribute("aria-sort")) head.setAttribute("aria-sort", "none");
    head.firstElementChild.addEventListener("click", () => sort(head));
  }
  for (const chip of chips) chip.addEventListener("click", () => {
    chip.setAttribute("aria-pressed", String(chip.getAttribute("aria-pressed") !== "true"));
    show();
  });
  search.addEventListener("input", show);
  if (search.value) show();
}
