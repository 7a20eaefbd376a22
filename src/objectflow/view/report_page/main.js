/* Start: theme, plots, gallery, and the pair in the address. */

const THEMES = ["system", "light", "dark"];

function startTheme() {
  const button = document.getElementById("theme");
  button.addEventListener("click", () => {
    const now = document.documentElement.dataset.theme ?? "system";
    const next = THEMES[(THEMES.indexOf(now) + 1) % THEMES.length];
    if (next === "system") delete document.documentElement.dataset.theme;
    else document.documentElement.dataset.theme = next;
    button.textContent = `Theme: ${next}`;
    view?.render();
  });
}

function startPlots() {
  const choice = document.getElementById("plot-metric");
  report.plots.forEach((metric, k) => choice.append(el("option", { value: k }, metric.name)));
  const draw = () => drawPlots(document.getElementById("plots"), report.plots[Number(choice.value)]);
  choice.addEventListener("change", draw);
  drawLegend(document.getElementById("plot-legend"));
  draw();
}

startTheme();
startPlots();
startGallery();
startPairs();
