"use strict";
// Charts: what benchmarks/charts.py says, drawn by plotly.js in the colours of the page.

function themed(layout, height) {
  const small = (axis) => (axis?.title ? { title: { font: { size: 12 }, ...axis.title } } : {});
  const axis = { gridcolor: colour("grid"), zerolinecolor: colour("grid"), linecolor: colour("line"), automargin: true };
  const themes = {
    xaxis: { ...axis, ...layout.xaxis, ...small(layout.xaxis) },
    yaxis: { ...axis, ...layout.yaxis, ...small(layout.yaxis) },
  };
  return {
    margin: { l: 8, r: 12, t: 8, b: 36 },
    paper_bgcolor: "rgba(0,0,0,0)",
    plot_bgcolor: "rgba(0,0,0,0)",
    font: { family: "system-ui, sans-serif", size: 13, color: colour("ink") },
    hoverlabel: { bgcolor: colour("card"), bordercolor: colour("line"), font: { color: colour("ink") } },
    dragmode: false, // a finger on a chart scrolls the page
    height,
    ...layout,
    ...themes,
  };
}

function inked(data) {
  const ink = colour("ink");
  const bars = (one, axis) => (one[axis] ? { [axis]: { color: ink, thickness: 1.3, width: 3, ...one[axis] } } : {});
  const lit = (part) => (part ? { ...part, color: Array.isArray(part.color) ? part.color.map(seen) : seen(part.color) } : part);
  return data.map((one) => {
    const made = { ...one, ...bars(one, "error_x"), ...bars(one, "error_y") };
    for (const name of ["marker", "line", "error_x", "error_y"]) if (made[name]) made[name] = lit(made[name]);
    return made;
  });
}

function draw(box, chart) {
  const data = chart.choices ? chart.choices[box.parentElement.querySelector("select").value] : chart.data;
  const config = { responsive: true, displayModeBar: false, scrollZoom: false };
  Plotly.react(box, inked(data), themed(chart.layout, chart.height), config);
}

function addChoice(box, chart) {
  if (!chart.choices) return;
  const choice = document.createElement("select");
  for (const name of Object.keys(chart.choices)) choice.add(new Option(name, name));
  choice.setAttribute("aria-label", "What is shown");
  choice.addEventListener("change", () => draw(box, chart));
  box.before(choice);
}

async function startCharts(charts) {
  const script = document.createElement("script");
  script.textContent = await text("plotly");
  document.head.append(script);
  for (const [id, chart] of Object.entries(charts)) {
    const box = document.getElementById(id);
    box.textContent = "";
    addChoice(box, chart);
    draw(box, chart);
  }
  const again = () => Object.entries(charts).forEach(([id, chart]) => draw(document.getElementById(id), chart));
  dark.addEventListener("change", again);
}
