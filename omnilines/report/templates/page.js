"use strict";
(async () => {
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

  // What a figure leaves open: colours of the page, so that light and dark need one specification.
  const template = () => {
    const line = { gridcolor: colour("--grid"), zerolinecolor: colour("--rule"), linecolor: colour("--rule") };
    const flat = { ...line, automargin: true, showline: true, ticks: "outside", tickcolor: colour("--rule") };
    const solid = { ...line, showbackground: false, showspikes: false };
    return {
      layout: {
        paper_bgcolor: "rgba(0,0,0,0)",
        plot_bgcolor: "rgba(0,0,0,0)",
        font: { family: getComputedStyle(document.body).fontFamily, size: 13, color: colour("--ink") },
        hoverlabel: { bgcolor: colour("--panel"), bordercolor: colour("--rule"), font: { color: colour("--ink") } },
        legend: { bgcolor: "rgba(0,0,0,0)" },
        modebar: { bgcolor: "rgba(0,0,0,0)", color: colour("--soft"), activecolor: colour("--ink") },
        xaxis: flat,
        yaxis: flat,
        scene: { bgcolor: colour("--paper"), xaxis: solid, yaxis: solid, zaxis: solid },
      },
    };
  };
  const config = {
    responsive: true,
    displaylogo: false,
    showSendToCloud: false, // plotly.js 4 offers by default to upload the chart to its maker
    plotlyServerURL: "",
    modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d", "resetCameraLastSave3d"],
  };

  const plots = [...document.querySelectorAll(".plot")];
  for (const plot of plots) {
    const { data, layout } = JSON.parse(plot.nextElementSibling.textContent);
    await Plotly.newPlot(plot, data, { ...layout, template: template() }, config);
    await new Promise((resume) => setTimeout(resume)); // let the page answer between figures
  }
  dark.addEventListener("change", () => plots.forEach((plot) => Plotly.relayout(plot, { template: template() })));
  document.documentElement.dataset.plots = "drawn";
})();

for (const frame of document.querySelectorAll(".frame")) {
  frame.addEventListener("click", () => {
    const large = frame.closest(".photo").classList.toggle("large");
    frame.setAttribute("aria-expanded", String(large));
  });
}
