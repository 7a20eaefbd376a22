/* The gallery: one card per pair, sorted by a score and drawn when it scrolls into view. */

const gallery = {
  cards: document.getElementById("cards"),
  metric: document.getElementById("sort-metric"),
  method: document.getElementById("sort-method"),
  order: document.getElementById("sort-order"),
  picture: document.getElementById("flow-picture"),
  filter: document.getElementById("filter"),
  boxes: document.getElementById("method-boxes"),
  shown: [],
};

const watcher = new IntersectionObserver(
  (entries) => {
    for (const entry of entries) {
      if (!entry.isIntersecting) continue;
      watcher.unobserve(entry.target);
      fillCard(entry.target);
    }
  },
  { rootMargin: "400px" },
);

function fillCard(card) {
  drawSheet(card.querySelector(".sheet"), Number(card.dataset.index), chosenMethods(), gallery.picture.value);
}

function chosenMethods() {
  return [...gallery.boxes.querySelectorAll("input:checked")].map((box) => Number(box.value));
}

function startGallery() {
  report.metrics.forEach((metric, k) => gallery.metric.append(el("option", { value: k }, metric.name)));
  gallery.metric.value = report.metrics.findIndex((metric) => metric.id === "mean_f");
  gallery.method.append(el("option", { value: "all" }, "all methods (mean)"));
  report.methods.forEach((method, m) => {
    gallery.method.append(el("option", { value: m }, method.name));
    const box = el("input", { type: "checkbox", value: m, checked: true, onchange: showGallery });
    gallery.boxes.append(el("label", {}, box, method.name));
  });
  for (const [kind, name] of Object.entries(FLOW_PICTURES)) gallery.picture.append(el("option", { value: kind }, name));
  for (const input of [gallery.metric, gallery.method, gallery.order]) input.addEventListener("change", showGallery);
  gallery.picture.addEventListener("change", () => {
    showKeys();
    showGallery();
  });
  gallery.filter.addEventListener("input", showGallery);
  document.addEventListener("keydown", (event) => {
    if (event.key !== "/" || event.target.matches("input, select, textarea") || pairDialog.open) return;
    event.preventDefault();
    gallery.filter.focus();
  });
  showKeys();
  showGallery();
}

/** The score by which a pair is sorted: that of one method, or the mean over all methods that have one. */
function sortScore(pair) {
  const k = Number(gallery.metric.value);
  const of = gallery.method.value === "all" ? report.methods.map((_, m) => m) : [Number(gallery.method.value)];
  const values = of.map((m) => pair.scores[m]?.[k]).filter((value) => value !== null && value !== undefined);
  return values.length ? values.reduce((sum, value) => sum + value, 0) / values.length : null;
}

function sortedPairs() {
  const words = gallery.filter.value.toLowerCase().split(/\s+/).filter(Boolean);
  const best = report.metrics[Number(gallery.metric.value)].best;
  const sign = (best === "high") === (gallery.order.value === "worst") ? 1 : -1;
  return report.pairs
    .map((pair, index) => ({ pair, index, score: sortScore(pair) }))
    .filter(({ pair }) => words.every((word) => `${pair.key} ${pair.scene}`.toLowerCase().includes(word)))
    .sort((a, b) => {
      if (a.score === null || b.score === null) return (a.score === null) - (b.score === null) || a.index - b.index;
      return sign * (a.score - b.score) || a.index - b.index;
    });
}

function showGallery() {
  const metric = report.metrics[Number(gallery.metric.value)];
  const entries = sortedPairs();
  gallery.shown = entries.map(({ index }) => index);
  document.getElementById("gallery-count").textContent = `${entries.length} of ${report.pairs.length} pairs`;
  watcher.disconnect();
  const cards = entries.map(({ pair, index, score }) => makeCard(pair, index, metric, score));
  gallery.cards.replaceChildren(...cards);
  if (!cards.length) gallery.cards.append(el("p", { class: "empty" }, "No pair matches the filter."));
  cards.forEach((card) => watcher.observe(card));
}

function makeCard(pair, index, metric, score) {
  const open = () => openPair(index);
  const value = `${metric.short} ${number(score, metric.digits)}${metric.unit ? ` ${metric.unit}` : ""}`;
  const head = el(
    "div",
    { class: "card-head" },
    el("button", { type: "button", onclick: open }, pair.key),
    el("span", { class: "note" }, `${value} · ${pair.facts}`),
    el("span", { class: "note full" }),
  );
  const sheet = el("div", { class: "sheet", onclick: open }, el("p", { class: "note" }, "loading"));
  // Estimated height until the card is drawn, so that the scroll bar does not jump.
  sheet.style.minHeight = "17rem";
  return el("article", { class: "card", "data-index": index }, head, sheet);
}

/** Show the legend of the flow colours. */
function showKeys() {
  const keys = document.getElementById("keys");
  const kind = gallery.picture.value;
  const size = 46;
  if (kind === "across") {
    const disk = paint(size, size, "wheel of directions", (i) => {
      const [right, down] = [(i % size) - (size - 1) / 2, Math.floor(i / size) - (size - 1) / 2];
      return wheel((2 * right) / size, (2 * down) / size);
    });
    disk.style.borderRadius = "50%";
    keys.replaceChildren(el("span", {}, disk, "hue = direction in the image, previous to current frame; rim = full colour"));
  } else {
    const color = kind === "depth" ? (t) => diverging(2 * t - 1) : heat;
    const bar = paint(160, 14, "bar of colours", (i) => color((i % 160) / 159));
    const ends = kind === "depth" ? ["towards the camera", "away from it"] : ["0", "full colour or more"];
    keys.replaceChildren(el("span", {}, ends[0], bar, ends[1]));
  }
  const grey = el("i", { class: "swatch" });
  grey.style.background = css(NO_DEPTH);
  keys.append(el("span", {}, el("span", {}, grey, "no depth")), el("span", {}, "The value of full colour is given beside each pair's key."));
}
