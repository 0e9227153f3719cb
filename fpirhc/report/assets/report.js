"use strict";
// Linked charts: one cursor, one zoom, one set of shown controllers. DATA is written by the page.
const RESPONSES = { nominal: "#009e73", desired: "#0072b2", deformed: "#e69f00", realised: "#d55e00" };
const colors = Object.fromEntries(DATA.controllers.map((c) => [c.name, c.color]));
const ink = getComputedStyle(document.documentElement).getPropertyValue("--ink").trim();
const faint = getComputedStyle(document.documentElement).getPropertyValue("--line").trim();
const shown = new Set(DATA.controllers.map((c) => c.name));
const sync = uPlot.sync("time");
const plots = [];
let zooming = false;

function zoomAll(source, key) {
  if (key !== "x" || zooming) return;
  zooming = true;
  const { min, max } = source.scales.x;
  for (const plot of plots) if (plot.chart !== source) plot.chart.setScale("x", { min, max });
  zooming = false;
}

// Time slots as pale bands: those of the chart's own controller, else of the first one that is shown and has some.
function bands(chart, spec) {
  const owner = DATA.controllers.find((c) => c.slots.length && (spec.only ? c.name === spec.only : shown.has(c.name)));
  if (!owner) return;
  const { ctx, bbox } = chart;
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  for (const [start, end, slot] of owner.slots) {
    const left = chart.valToPos(start, "x", true);
    ctx.fillStyle = DATA.bands[slot % DATA.bands.length] + "22";
    ctx.fillRect(left, bbox.top, chart.valToPos(end, "x", true) - left, bbox.height);
  }
  ctx.restore();
}

function draw(spec) {
  const box = document.createElement("div");
  box.className = "chart";
  const title = document.createElement("h3");
  title.textContent = spec.title + " [" + spec.unit + "]";
  box.append(title);
  document.getElementById("charts").append(box);
  const series = [{ label: "t [" + DATA.timeUnit + "]" }].concat(
    spec.series.map((s) => ({
      label: s.name,
      stroke: colors[s.name] || RESPONSES[s.name] || ink,
      width: 1.2,
      dash: s.name === "reference" ? [5, 4] : undefined,
      value: (_, v) => (v === null || v === undefined ? "" : v.toPrecision(4)),
    }))
  );
  const axis = { stroke: ink, grid: { stroke: faint, width: 1 }, ticks: { stroke: faint, width: 1 } };
  const options = {
    width: box.clientWidth || 520,
    height: 210,
    series,
    // What was predicted before the run, between its two edges.
    bands: spec.band ? [{ series: spec.band, fill: "#0072b222" }] : [],
    scales: { x: { time: false } },
    axes: [{ ...axis }, { ...axis, size: 62 }],
    cursor: { sync: { key: sync.key } },
    hooks: { setScale: [zoomAll], drawClear: [(chart) => bands(chart, spec)] },
  };
  const chart = new uPlot(options, [DATA.time, ...spec.series.map((s) => s.values)], box);
  plots.push({ chart, box, spec });
}

function show() {
  for (const { chart, box, spec } of plots) {
    if (spec.only) {
      box.hidden = !shown.has(spec.only) || shown.size > 2;
      continue;
    }
    spec.series.forEach((s, k) => {
      if (s.name in colors) chart.setSeries(k + 1, { show: shown.has(s.name) });
    });
  }
}

function control(controller) {
  const label = document.createElement("label");
  const box = document.createElement("input");
  box.type = "checkbox";
  box.checked = true;
  box.addEventListener("change", () => {
    box.checked ? shown.add(controller.name) : shown.delete(controller.name);
    show();
  });
  const swatch = document.createElement("span");
  swatch.className = "swatch";
  swatch.style.background = controller.color;
  label.append(box, swatch, document.createTextNode(controller.name));
  document.getElementById("controllers").append(label);
  return { box, name: controller.name };
}

const boxes = DATA.controllers.map(control);
DATA.charts.forEach(draw);
// Begin with the controllers of the verdict's first sentence, so that a diverged one does not set every scale.
if (DATA.begin.length) {
  shown.clear();
  for (const b of boxes) {
    b.box.checked = DATA.begin.includes(b.name);
    if (b.box.checked) shown.add(b.name);
  }
}
show();
addEventListener("resize", () => plots.forEach(({ chart, box }) => box.hidden || chart.setSize({ width: box.clientWidth, height: 210 })));
