/* The thumbnails of the gallery, each drawn on a canvas. */

function photoCanvas(image, width, height, label) {
  const canvas = el("canvas", { width, height, role: "img", "aria-label": label });
  canvas.getContext("2d").drawImage(image, 0, 0, width, height);
  return canvas;
}

/** The flow of one layer on the points' grid; pixels without depth are grey. */
function flowCanvas(pair, method, kind) {
  const { columns, rows } = pair;
  const count = columns * rows;
  const flow = pair.layers.get(method).flow;
  const truth = pair.layers.get(TRUTH).flow;
  return paint(columns, rows, `flow of ${layerName(method)}`, (i) =>
    pair.depth[i] === 0 ? NO_DEPTH : flowColor(kind, flow, truth, i, count, pair.full),
  );
}

/** The masks of one layer over the current frame in grey. */
function maskCanvas(pair, method) {
  const { labels, colors } = pair.layers.get(method);
  const { photo } = pair;
  return paint(pair.width, pair.height, `segmentation of ${layerName(method)}`, (i) =>
    objectColor(colors[labels[i]], photo, i),
  );
}

/** A point's colour by object: the mask's colour, slightly shaded by the photo; grey for the background. */
function objectColor(color, photo, i) {
  const light = (0.3 * photo[4 * i] + 0.59 * photo[4 * i + 1] + 0.11 * photo[4 * i + 2]) / 255;
  if (!color) return [0, 1, 2].map(() => Math.round(70 + 150 * light));
  return color.map((part) => Math.round(part * (0.72 + 0.38 * light)));
}

function paint(width, height, label, colorOf) {
  const canvas = el("canvas", { width, height, role: "img", "aria-label": label });
  const context = canvas.getContext("2d");
  const image = context.createImageData(width, height);
  for (let i = 0; i < width * height; i++) {
    const [red, green, blue] = colorOf(i);
    image.data[4 * i] = red;
    image.data[4 * i + 1] = green;
    image.data[4 * i + 2] = blue;
    image.data[4 * i + 3] = 255;
  }
  context.putImageData(image, 0, 0);
  return canvas;
}

/** The figure of one pair: both frames, a column per method, and the truth; flow above, masks below. */
async function drawSheet(sheet, index, methods, kind) {
  const pair = await loadPair(index);
  const { width, height } = pair;
  const first = column("frames");
  first.append(photoCanvas(pair.prev, width, height, "previous frame"));
  first.append(photoCanvas(pair.curr, width, height, "current frame"));
  const columns = [first];
  for (const method of [...methods, TRUTH]) {
    const node = column(layerName(method));
    if (pair.layers.has(method)) node.append(flowCanvas(pair, method, kind), maskCanvas(pair, method));
    else node.append(el("p", { class: "note" }, "no result"));
    node.append(method === TRUTH ? truthLine(pair) : scoreLine(index, method));
    columns.push(node);
  }
  sheet.replaceChildren(...columns);
  sheet.style.minHeight = "";
  const full = sheet.parentElement?.querySelector(".full");
  if (full) full.textContent = `full colour ${number(100 * pair.full, 1)} cm`;
}

function column(name) {
  return el("div", { class: "column" }, el("div", { class: "name", title: name }, name));
}

function truthLine(pair) {
  const count = pair.layers.get(TRUTH).objects.length;
  return el("div", { class: "score" }, `${count} object${count === 1 ? "" : "s"}`);
}

function scoreLine(index, method) {
  const scores = report.pairs[index].scores[method];
  if (!scores) return el("div", { class: "score" }, "not scored");
  const line = el("div", { class: "score" });
  for (const id of ["epe_masked", "mean_f"]) {
    const k = report.metrics.findIndex((metric) => metric.id === id);
    const { short, unit, digits } = report.metrics[k];
    line.append(`${short} `, el("b", {}, number(scores[k], digits)), unit ? ` ${unit} ` : " ");
  }
  return line;
}
