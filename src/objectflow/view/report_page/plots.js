/* Breakdown plots: one small chart per attribute, one line per method. */

const SVG = "http://www.w3.org/2000/svg";
const MARKS = ["circle", "square", "diamond", "triangle"];

function svg(tag, attributes, ...children) {
  const node = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...children);
  return node;
}

/** A mark; methods differ in both shape and colour. */
function mark(method, x, y, size = 4.2) {
  const color = `var(--m${method % 8})`;
  const form = MARKS[method % MARKS.length];
  if (form === "circle") return svg("circle", { cx: x, cy: y, r: size, fill: color });
  if (form === "square") {
    return svg("rect", { x: x - size * 0.9, y: y - size * 0.9, width: size * 1.8, height: size * 1.8, fill: color });
  }
  const points =
    form === "diamond"
      ? [[0, -1.25], [1.25, 0], [0, 1.25], [-1.25, 0]]
      : [[0, -1.25], [1.15, 0.9], [-1.15, 0.9]];
  return svg("polygon", { points: points.map(([a, b]) => `${x + a * size},${y + b * size}`).join(" "), fill: color });
}

function drawLegend(target) {
  target.replaceChildren(
    ...report.methods.map((method, m) =>
      el("span", {}, svg("svg", { width: 14, height: 14, "aria-hidden": "true" }, mark(m, 7, 7, 5)), method.name),
    ),
  );
}

function drawPlots(target, metric) {
  target.replaceChildren(...report.breakdowns.map((breakdown) => plotFigure(breakdown, metric)));
}

function plotFigure(breakdown, metric) {
  const values = breakdown.values[metric.id];
  const chart = drawChart(breakdown, metric, values);
  const head = el("tr", {}, el("th", {}, breakdown.name), ...breakdown.groups.map((group) => el("th", {}, group)));
  const rows = report.methods.map((method, m) =>
    el(
      "tr",
      {},
      el("th", { scope: "row" }, method.name),
      ...values[m].map((cell) => el("td", {}, cell ? number(cell[0], metric.digits) : "–")),
    ),
  );
  const numbers = el("details", {}, el("summary", {}, "Numbers"));
  numbers.append(el("div", { class: "scroll" }, el("table", {}, el("thead", {}, head), el("tbody", {}, ...rows))));
  return el("figure", {}, el("figcaption", {}, breakdown.name), chart, numbers);
}

function drawChart(breakdown, metric, values) {
  const [width, height, left, right, top, bottom] = [400, 210, 40, 8, 12, 40];
  const top_of = Math.max(...values.flat().map((cell) => (cell ? Math.max(cell[0] ?? 0, cell[2] ?? 0) : 0)));
  const ticks = metric.best === "high" ? [0, 0.25, 0.5, 0.75, 1] : niceTicks(top_of);
  const end = ticks[ticks.length - 1];
  const y = (value) => height - bottom - (Math.min(value, end) / end) * (height - bottom - top);
  const step = (width - left - right) / breakdown.groups.length;
  const spread = Math.min(step * 0.6, 16 * report.methods.length);
  const x = (group, method) =>
    left + step * (group + 0.5) + spread * ((method + 0.5) / report.methods.length - 0.5);
  const label = `${metric.name} by ${breakdown.name}; the numbers are in the table below it`;
  const root = svg("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": label });
  for (const tick of ticks) {
    root.append(svg("line", { class: "grid", x1: left, x2: width - right, y1: y(tick), y2: y(tick) }));
    root.append(svg("text", { x: left - 6, y: y(tick) + 4, "text-anchor": "end" }, String(Number(tick.toPrecision(3)))));
  }
  breakdown.groups.forEach((group, g) => {
    const middle = left + step * (g + 0.5);
    root.append(svg("text", { x: middle, y: height - 22, "text-anchor": "middle" }, group));
    root.append(svg("text", { x: middle, y: height - 7, "text-anchor": "middle" }, breakdown.counts[g]));
  });
  report.methods.forEach((method, m) => drawSeries(root, method, m, metric, breakdown, values[m], x, y));
  return root;
}

function drawSeries(root, method, m, metric, breakdown, cells, x, y) {
  const color = `var(--m${m % 8})`;
  const known = cells.map((cell, g) => [cell, g]).filter(([cell]) => cell && cell[0] !== null);
  const points = known.map(([cell, g]) => `${x(g, m)},${y(cell[0])}`).join(" ");
  root.append(svg("polyline", { points, fill: "none", stroke: color, "stroke-width": 1.4, opacity: 0.55 }));
  for (const [cell, g] of known) {
    const [value, low, high] = cell;
    const node = svg("g", {});
    const interval = low === null ? "" : ` [${number(low, metric.digits)}, ${number(high, metric.digits)}]`;
    const words = `${method.name}, ${breakdown.groups[g]}: ${number(value, metric.digits)}${interval} ${metric.unit}`;
    node.append(svg("title", {}, words));
    if (low !== null) {
      const ends = { x1: x(g, m), x2: x(g, m), y1: y(low), y2: y(high) };
      node.append(svg("line", { ...ends, stroke: color, "stroke-width": 1.6 }));
    }
    node.append(mark(m, x(g, m), y(value)));
    root.append(node);
  }
}

/** Ticks from 0 in three to five round steps to above the largest value. */
function niceTicks(largest) {
  if (!(largest > 0)) return [0, 1];
  const raw = largest / 4;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = power * [1, 2, 2.5, 5, 10].find((factor) => factor * power >= raw * 0.999);
  return Array.from({ length: Math.ceil(largest / step - 1e-9) + 1 }, (_, k) => k * step);
}
