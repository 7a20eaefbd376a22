/* Start: theme, plots, gallery, and the pair in the address. */

function startPlots() {
  const choice = document.getElementById("plot-metric");
  report.plots.forEach((metric, k) => choice.append(el("option", { value: k }, metric.name)));
  const draw = () => drawPlots(document.getElementById("plots"), report.plots[Number(choice.value)]);
  choice.addEventListener("change", draw);
  drawLegend(document.getElementById("plot-legend"));
  draw();
}

startTheme();
window.addEventListener("themechange", () => view?.render());
startPlots();
startGallery();
startPairs();
