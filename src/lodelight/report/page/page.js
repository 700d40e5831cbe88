"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const dark = matchMedia("(prefers-color-scheme: dark)");
const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

// Colours of text and grids belong to the page, not to the figures.
function dressed(layout) {
  const ink = css("--soft"), rule = css("--rule");
  const axis = { gridcolor: rule, zerolinecolor: rule, linecolor: rule, automargin: true };
  const own = layout.scene || {};
  const scene = {};
  for (const name of ["xaxis", "yaxis", "zaxis"]) {
    const plain = { backgroundcolor: "rgba(0,0,0,0)", gridcolor: rule, zerolinecolor: rule, title: { text: name[0] + " (m)" } };
    scene[name] = { ...plain, ...(own[name] || {}) };
  }
  return {
    ...layout,
    xaxis: { ...axis, ...(layout.xaxis || {}) },
    yaxis: { ...axis, ...(layout.yaxis || {}) },
    ...(layout.yaxis2 ? { yaxis2: { ...axis, ...layout.yaxis2 } } : {}),
    scene: { ...own, ...scene },
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
    font: { family: getComputedStyle(document.body).fontFamily, size: 12, color: ink },
    margin: { l: 56, r: 16, t: 8, b: 44, ...(layout.margin || {}) },
    legend: { orientation: "h", x: 0, y: 1.02, yanchor: "bottom", bgcolor: "rgba(0,0,0,0)" },
    modebar: { bgcolor: "rgba(0,0,0,0)", color: rule, activecolor: ink },
    showlegend: true, hovermode: "closest",
  };
}

const config = { responsive: true, displaylogo: false, modeBarButtons: [["toImage"]] };
const timed = [];
let following = false;
for (const [id, figure] of Object.entries(data.figures)) {
  const plot = document.getElementById(id);
  Plotly.newPlot(plot, figure.data, dressed(figure.layout), config);
  if (figure.time) timed.push(plot);
}
dark.addEventListener("change", () => {
  for (const [id, figure] of Object.entries(data.figures)) Plotly.relayout(id, dressed(figure.layout));
});
// What is drawn over time is zoomed together.
for (const plot of timed) {
  plot.on("plotly_relayout", (change) => {
    const range = [change["xaxis.range[0]"], change["xaxis.range[1]"]];
    const reset = change["xaxis.autorange"];
    if (following || (range[0] === undefined && !reset)) return;
    following = true;
    const others = timed.filter((other) => other !== plot);
    const wanted = reset ? { "xaxis.autorange": true } : { "xaxis.range": range };
    Promise.all(others.map((other) => Plotly.relayout(other, wanted))).finally(() => { following = false; });
  });
}

function listEvents(events) {
  const body = document.querySelector("#events tbody");
  const kinds = [...new Set(events.map((event) => event.kind))];
  const hidden = new Set(kinds.filter((kind) => kind.endsWith("(none)")));
  const words = document.getElementById("words");
  function list() {
    const wanted = words.value.toLowerCase();
    const rows = events.filter((event) =>
      !hidden.has(event.kind) && (event.kind + " " + event.what).toLowerCase().includes(wanted));
    body.replaceChildren(...rows.map((event) => {
      const row = document.createElement("tr");
      for (const text of [event.t_s === null ? "" : event.t_s.toFixed(2), event.kind, event.what]) row.insertCell().textContent = text;
      return row;
    }));
  }
  for (const kind of kinds) {
    const button = document.createElement("button");
    button.textContent = kind;
    button.setAttribute("aria-pressed", String(!hidden.has(kind)));
    button.onclick = () => {
      hidden.has(kind) ? hidden.delete(kind) : hidden.add(kind);
      button.setAttribute("aria-pressed", String(!hidden.has(kind)));
      list();
    };
    document.getElementById("kinds").append(button);
  }
  words.oninput = list;
  list();
}
if (data.events) listEvents(data.events);
