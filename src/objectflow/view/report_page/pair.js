/* One pair in a dialog: the 3D view, the objects' motions and the scores of every method. */

const pairDialog = document.getElementById("pair");
const state = { index: null, pair: null, method: TRUTH, color: "objects" };
const COLORS = { photo: "photo", objects: "object", across: "flow across", depth: "flow in depth", error: "error" };
const timeSlider = document.getElementById("time");
const arrowsBox = document.getElementById("arrows");
let view = null;

function startPairs() {
  document.getElementById("pair-close").addEventListener("click", () => pairDialog.close());
  document.getElementById("pair-prev").addEventListener("click", () => stepPair(-1));
  document.getElementById("pair-next").addEventListener("click", () => stepPair(1));
  document.getElementById("reset").addEventListener("click", () => view?.reset());
  timeSlider.addEventListener("input", showScene);
  arrowsBox.addEventListener("change", showScene);
  pairDialog.addEventListener("close", () => {
    state.index = null;
    history.replaceState(null, "", "#gallery");
  });
  pairDialog.addEventListener("keydown", pairKey);
  window.addEventListener("hashchange", openFromAddress);
  openFromAddress();
}

function openFromAddress() {
  if (!location.hash.startsWith("#pair=")) return;
  const key = decodeURIComponent(location.hash.slice(6));
  const index = report.pairs.findIndex((pair) => pair.key === key);
  if (index >= 0) openPair(index);
}

async function openPair(index) {
  state.index = index;
  const { key, scene, facts } = report.pairs[index];
  document.getElementById("pair-title").textContent = key;
  document.getElementById("pair-facts").textContent = scene === key ? facts : `scene ${scene} · ${facts}`;
  if (!pairDialog.open) pairDialog.showModal();
  history.replaceState(null, "", `#pair=${encodeURIComponent(key)}`);
  const position = gallery.shown.indexOf(index);
  document.getElementById("pair-prev").disabled = position <= 0;
  document.getElementById("pair-next").disabled = position < 0 || position === gallery.shown.length - 1;
  const pair = await loadPair(index);
  if (state.index !== index) return;
  state.pair = pair;
  if (!pair.layers.has(state.method)) state.method = TRUTH;
  showChoices();
  showScores();
  drawSheet(pairSheet(), index, report.methods.map((_, m) => m), gallery.picture.value);
  if (startView()) {
    view.setPair(pair);
    timeSlider.value = 1;
    showScene();
  }
}

function pairSheet() {
  const sheet = el("div", { class: "sheet" });
  document.getElementById("pair-figure").replaceChildren(el("div", { class: "card" }, sheet));
  return sheet;
}

/** Create the page's WebGL context on first use; show a message where the browser has none. */
function startView() {
  if (view) return true;
  const canvas = document.getElementById("scene");
  const message = document.getElementById("scene-message");
  try {
    view = new SceneView(canvas);
  } catch (error) {
    canvas.hidden = true;
    message.hidden = false;
    message.textContent = `This browser cannot draw in 3D (WebGL 2 is off): ${error.message}`;
  }
  return view !== null;
}

function showScene() {
  const { pair, method, color } = state;
  if (view && pair) view.show({ method, color, time: Number(timeSlider.value), arrows: arrowsBox.checked });
  showObjects();
}

function showChoices() {
  const layers = [TRUTH, ...report.methods.map((_, m) => m)].filter((method) => state.pair.layers.has(method));
  const pick = (name, entries, chosen, act) =>
    entries.map(([value, text]) => {
      const input = el("input", { type: "radio", name, value, checked: value === chosen });
      input.addEventListener("change", () => act(value));
      return el("label", {}, input, el("span", {}, text));
    });
  const setLayer = (method) => {
    state.method = method;
    showScores();
    showScene();
  };
  const setColor = (color) => {
    state.color = color;
    showScene();
  };
  const names = layers.map((method) => [method, layerName(method)]);
  document.getElementById("layer-choice").replaceChildren(...pick("layer", names, state.method, setLayer));
  document.getElementById("color-choice").replaceChildren(...pick("color", Object.entries(COLORS), state.color, setColor));
}

/** Show the displacement and rotation of each object of the chosen layer. */
function showObjects() {
  const { objects } = state.pair.layers.get(state.method);
  const rows = objects.map((object) => {
    const swatch = el("i", { class: "swatch" });
    swatch.style.background = css(object.color);
    return el(
      "tr",
      {},
      el("th", { scope: "row" }, swatch, object.name),
      el("td", {}, `${number(100 * Math.hypot(...object.translation), 1)} cm`),
      el("td", {}, object.degrees === null ? "–" : `${number(object.degrees, 0)}°`),
    );
  });
  const head = el("tr", {}, el("th", {}, `Objects of ${layerName(state.method)}`), el("th", {}, "displacement"), el("th", {}, "rotation"));
  const table = el("table", {}, el("thead", {}, head), el("tbody", {}, ...rows));
  const none = el("p", { class: "note" }, `${layerName(state.method)}: no objects.`);
  document.getElementById("objects").replaceChildren(rows.length ? table : none);
}

function showScores() {
  const scores = report.pairs[state.index].scores;
  const head = el("tr", {}, el("th", {}, "Scores"), ...report.metrics.map(({ short, unit }) => el("th", {}, short, el("small", {}, unit || " "))));
  const rows = report.methods.map((method, m) =>
    el(
      "tr",
      { class: m === state.method ? "chosen" : "" },
      el("th", { scope: "row" }, method.name),
      ...report.metrics.map(({ digits }, k) => el("td", {}, number(scores[m]?.[k], digits))),
    ),
  );
  const table = el("table", {}, el("thead", {}, head), el("tbody", {}, ...rows));
  document.getElementById("pair-scores").replaceChildren(el("div", { class: "scroll" }, table));
}

function stepPair(step) {
  const position = gallery.shown.indexOf(state.index) + step;
  if (position >= 0 && position < gallery.shown.length) openPair(gallery.shown[position]);
}

function pairKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const press = event.key.toLowerCase();
  const radios = (id) => [...document.getElementById(id).querySelectorAll("input")];
  if (press === "n") stepPair(1);
  else if (press === "p") stepPair(-1);
  else if (press === "r") view?.reset();
  else if (press >= "1" && press <= "9") radios("layer-choice")[Number(press) - 1]?.click();
  else if (press === "c") {
    const all = radios("color-choice");
    all[(all.findIndex((input) => input.checked) + 1) % all.length]?.click();
  } else return;
  event.preventDefault();
}
