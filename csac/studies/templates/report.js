"use strict";

// Tables: a click on a heading sorts by its column, another one the other way round. Summaries stay at the end.
function valueOf(row, column, isNumeric) {
  const cell = row.cells[column];
  if (!isNumeric) return cell.textContent;
  const text = cell.dataset.value;
  if (text === undefined) return NaN;
  return text.endsWith("inf") ? (text.startsWith("-") ? -Infinity : Infinity) : Number(text);
}

function compare(one, other, direction) {
  if (typeof one === "string") return direction * one.localeCompare(other, "en", { numeric: true });
  if (Number.isNaN(one) || Number.isNaN(other)) return Number.isNaN(one) - Number.isNaN(other); // empty cells last
  return one === other ? 0 : direction * (one < other ? -1 : 1);
}

function sort(table, heading) {
  const column = heading.cellIndex;
  const isNumeric = heading.classList.contains("number");
  const isAscending = heading.getAttribute("aria-sort") !== "ascending";
  for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
  heading.setAttribute("aria-sort", isAscending ? "ascending" : "descending");
  const rows = [...table.tBodies[0].rows];
  const summaries = rows.filter((row) => row.classList.contains("summary"));
  const others = rows.filter((row) => !row.classList.contains("summary"));
  others.sort((one, other) =>
    compare(valueOf(one, column, isNumeric), valueOf(other, column, isNumeric), isAscending ? 1 : -1));
  table.tBodies[0].append(...others, ...summaries);
}

for (const table of document.querySelectorAll("table")) {
  if (table.tBodies[0].rows.length < 2) continue;
  for (const heading of table.tHead.rows[0].cells) {
    const button = document.createElement("button");
    button.type = "button";
    button.title = "Sort by this column";
    button.append(...heading.childNodes);
    button.addEventListener("click", () => sort(table, heading));
    heading.append(button);
  }
}

// Figures: drawn once they come near, in the colours of the page, and again when these change.
const dark = window.matchMedia("(prefers-color-scheme: dark)");
const OPTIONS = { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["lasso2d", "select2d", "autoScale2d"] };

function colours() {
  const style = getComputedStyle(document.documentElement);
  return Object.fromEntries(["page", "raised", "text", "quiet", "line"].map((name) =>
    [name, style.getPropertyValue(`--${name}`).trim()]));
}

function draw(plot) {
  const { page, raised, text, quiet, line } = colours();
  const told = plot.parentElement.querySelector("script").textContent;
  const { data, layout } = JSON.parse(dark.matches ? told.replaceAll(CONTRAST, text) : told);
  const axis = {
    automargin: true, gridcolor: line, linecolor: quiet, zerolinecolor: line, tickcolor: quiet, ticks: "outside",
    nticks: plot.clientWidth < 480 ? 5 : 9,
  };
  const small = plot.clientWidth < 480;
  const isOne = data.filter((trace) => trace.showlegend !== false).length < 2;
  Plotly.react(plot, data, {
    autosize: true,
    margin: { l: 56, r: 12, t: 10, b: 44 },
    paper_bgcolor: "rgba(0,0,0,0)",
    plot_bgcolor: "rgba(0,0,0,0)",
    font: { color: text, family: "inherit", size: small ? 11 : 13 },
    hoverlabel: { bgcolor: raised, bordercolor: line, font: { color: text, size: 12 }, namelength: -1 },
    legend: {
      orientation: "h", xanchor: "left", x: 0, yref: "container", yanchor: "bottom", y: 0, itemsizing: "constant",
      bgcolor: page,
    },
    showlegend: !isOne,
    uirevision: "kept",
    separators: ".,",
    ...layout,
    xaxis: { ...axis, ...layout.xaxis, title: { standoff: 8, ...layout.xaxis.title } },
    yaxis: { ...axis, ...layout.yaxis },
  }, OPTIONS);
  for (const label of plot.querySelectorAll(".legendtoggle")) label.style.cursor = "pointer";
}

const near = new IntersectionObserver((entries) => {
  for (const { isIntersecting, target } of entries) {
    if (!isIntersecting) continue;
    near.unobserve(target);
    target.classList.add("drawn");
    draw(target);
  }
}, { rootMargin: "800px" });
for (const plot of document.querySelectorAll(".plot")) near.observe(plot);
dark.addEventListener("change", () => document.querySelectorAll(".plot.drawn").forEach(draw));
