"use strict";
(async () => {
  const root = document.documentElement;
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const colour = (name) => getComputedStyle(root).getPropertyValue(name).trim();

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
  const recolour = () => plots.filter((plot) => plot.data).forEach((plot) => Plotly.relayout(plot, { template: template() }));
  dark.addEventListener("change", recolour);
  // Paper is white, and nothing unfolds on it.
  const folded = () => document.querySelectorAll("details:not([open])");
  let opened = [];
  addEventListener("beforeprint", () => {
    root.classList.add("printing");
    opened = [...folded()];
    opened.forEach((one) => (one.open = true));
    recolour();
  });
  addEventListener("afterprint", () => {
    root.classList.remove("printing");
    opened.forEach((one) => (one.open = false));
    recolour();
  });

  await new Promise((resume) => requestAnimationFrame(() => setTimeout(resume))); // what can be read is shown before any figure
  const library = document.createElement("script");
  library.textContent = document.getElementById("plotly-js").textContent; // five megabytes, which are not compiled before that
  document.head.append(library);
  for (const plot of plots) {
    const { data, layout } = JSON.parse(plot.nextElementSibling.textContent);
    if (layout.scene && plot.clientWidth < 600) {
      const { domain = { x: [0, 1] }, camera } = layout.scene, before = ((domain.x[1] - domain.x[0]) * plot.clientWidth) / plot.clientHeight;
      // On a narrow page the names would hide the scene: they stand below it.
      plot.style.aspectRatio = 0.8;
      layout.legend = { ...layout.legend, orientation: "h", y: 0, yanchor: "top" };
      const names = new Set(data.filter((trace) => trace.showlegend !== false).map((trace) => trace.name));
      layout.margin = { ...layout.margin, b: Math.min(130, 16 + 22 * Math.ceil(names.size / 3)) };
      // The field of view is that up and down: what was wide is seen whole from farther away.
      const away = Math.max(1, (before * (plot.clientWidth / 0.8 - layout.margin.b)) / plot.clientWidth);
      const from = ([k, at]) => [k, (camera.center?.[k] ?? 0) * (1 - away) + away * at];
      const turned = camera?.eye && { ...camera, eye: Object.fromEntries(Object.entries(camera.eye).map(from)) };
      layout.scene = { ...layout.scene, domain: { x: [0, 1], y: [0, 1] }, ...(turned && { camera: turned }) };
    }
    // Beside an image's scale bar and legend a narrow page leaves no width to it: it takes height.
    if (layout.yaxis?.scaleanchor && plot.clientWidth < 600) plot.style.aspectRatio = Math.min(0.8, plot.clientWidth / plot.clientHeight);
    await Plotly.newPlot(plot, data, { ...layout, template: template() }, config);
    if (layout.meta?.lines) pickable(plot, layout.meta);
    await new Promise((resume) => setTimeout(resume)); // let the page answer between figures
  }
  root.dataset.plots = "drawn";
})();

// A click on a line of the scene says what is known of it, and the photos that show it.
function pickable(plot, known) {
  const said = Object.assign(document.createElement("p"), { className: "picked-line", textContent: "Click a line to see which photos show it." });
  said.setAttribute("role", "status");
  plot.after(said);
  plot.on("plotly_click", ({ points }) => pick(said, known, points[0]));
}

function pick(said, { photos, lines }, point) {
  const track = Object.keys(lines).find((name) => point.text?.startsWith(`${name}: `));
  if (track === undefined) return; // a camera
  const seen = lines[track], text = point.text.slice(track.length).replaceAll("<br>", ", ");
  said.replaceChildren(Object.assign(document.createElement("strong"), { textContent: track }), `${text}; ${point.data.name}.`);
  if (seen.length) said.append(` Seen in ${seen.length} ${seen.length > 1 ? "photos" : "photo"}: `);
  seen.forEach((number, place) => {
    if (place) said.append(", ");
    const shown = figureOf(photos[number]);
    if (!shown) return said.append(photos[number]);
    const link = Object.assign(document.createElement("button"), { type: "button", textContent: photos[number] });
    link.addEventListener("click", () => (enlarge(shown, true), shown.scrollIntoView()));
    said.append(link);
  });
  for (const path of document.querySelectorAll(".frame .model path"))
    path.classList.toggle("picked", path.firstElementChild?.textContent === track);
}

const figureOf = (name) => [...document.querySelectorAll(".photo")].find((figure) => figure.dataset.photo === name);

function enlarge(figure, large) {
  figure.classList.toggle("large", large);
  figure.querySelector(".frame").setAttribute("aria-expanded", String(large));
}

for (const frame of document.querySelectorAll(".frame")) {
  const figure = frame.closest(".photo");
  frame.addEventListener("click", () => enlarge(figure, !figure.classList.contains("large")));
}

for (const slider of document.querySelectorAll(".reveal input"))
  slider.addEventListener("input", () => slider.closest("section").style.setProperty("--revealed", `${slider.value}%`));

// Tables of more than two rows are sorted by a click on the title of a column: first upwards, then downwards.
for (const table of document.querySelectorAll(".scroll table:not(.in-order)")) {
  const body = table.tBodies[0], titles = [...table.tHead.rows[0].cells];
  if (body.rows.length < 3) continue;
  titles.forEach((title, column) => {
    if (title.querySelector(".unseen")) return;
    const button = Object.assign(document.createElement("button"), { type: "button", className: "sort" });
    button.append(...title.childNodes);
    title.append(button);
    button.addEventListener("click", () => {
      const up = title.getAttribute("aria-sort") !== "ascending";
      titles.forEach((other) => other.removeAttribute("aria-sort"));
      title.setAttribute("aria-sort", up ? "ascending" : "descending");
      body.append(...sorted([...body.rows], column, title.classList.contains("number"), up ? 1 : -1));
    });
  });
}

function sorted(rows, column, numbers, sign) {
  const text = (row) => row.cells[column].textContent.trim();
  const value = (row) => parseFloat(text(row).replaceAll(",", ""));
  const unknown = (row) => numbers && Number.isNaN(value(row)); // those are last either way
  return rows.sort((a, b) => unknown(a) - unknown(b)
    || sign * (numbers ? value(a) - value(b) || 0 : text(a).localeCompare(text(b), undefined, { numeric: true })));
}
