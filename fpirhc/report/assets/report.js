"use strict";
// Linked charts: one cursor, one zoom, one set of shown controllers. DATA is written by the page.
const HEIGHT = 220; // of a chart, px
const labelled = { size: 30, labelSize: 18, labelGap: 0, labelFont: "12px system-ui,sans-serif" };
// Color, width and dashes of lines that are no controller's; those drawn later lie above.
const LINES = {
  realised: ["#d55e0055", 3],
  deformed: ["#e69f00", 1.2, [6, 3]],
  desired: ["#0072b2", 1.2],
  nominal: ["#009e73", 1.6, [2, 4]],
  reference: [null, 1.2, [5, 4]],
  "set-point": [null, 1.2, [1, 3]],
};
const styles = getComputedStyle(document.documentElement), ink = styles.getPropertyValue("--ink").trim();
// The palette's black is the page's ink, which is light where the page is dark.
const tone = (color) => (color === "#111111" ? ink : color);
const colors = Object.fromEntries(DATA.controllers.map((c) => [c.name, tone(c.color)]));
const faint = styles.getPropertyValue("--line").trim();
const shown = new Set(DATA.controllers.map((c) => c.name));
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

// Hard limits as thin dashed lines.
function limits({ ctx, bbox, scales, valToPos }, spec) {
  ctx.save();
  ctx.strokeStyle = styles.getPropertyValue("--worse");
  ctx.setLineDash([8, 6]);
  for (const v of spec.limits ?? [])
    if (v !== null && v >= scales.y.min && v <= scales.y.max) ctx.stroke(new Path2D(`M${bbox.left} ${valToPos(v, "y", true)}h${bbox.width}`));
  ctx.restore();
}

// Whether a run that a chart shows ended early.
const ended = (spec) => DATA.controllers.some((c) => c.ended && (spec.only ? c.name === spec.only : shown.has(c.name)));

// Moving pictures show the time of the charts' cursor, and the charts' cursor is at the time that they show.
const players = [];
function follow(chart) {
  if (chart.cursor.left >= 0) for (const one of players) one.follow(chart.posToVal(chart.cursor.left, "x"));
}
function point(time) {
  for (const { chart, box } of plots) if (!box.hidden) chart.setCursor({ left: chart.valToPos(time, "x"), top: -10 }, false);
}

const element = (tag, content) => Object.assign(document.createElement(tag), content);

// All boxes stand in the grid before a chart is drawn: a box that is alone in it is as wide as the page.
function place(spec) {
  const [low, high] = spec.limits ?? [];
  const bounded = (low ?? high ?? null) === null ? "" : `, limits ${low ?? "-∞"} to ${high ?? "∞"}`;
  const box = element("div", { className: "chart" });
  box.append(element("h3", { textContent: `${spec.title} [${spec.unit}]${bounded}` }));
  document.getElementById(spec.only ? "responses" : spec.real ? "reality" : "charts").append(box);
  return { box, spec };
}

function draw({ box, spec }) {
  const label = "t [" + DATA.timeUnit + "]";
  const line = (s) => {
    const [color, width, dash] = LINES[s.name] || [null, 1.2];
    const points = { show: s.values.filter((v) => v !== null).length === 1, size: 9, fill: colors[s.name] }; // a value alone is a dot
    const value = (_, v) => (v === null || v === undefined ? "" : numberText(v));
    return { label: s.name, stroke: colors[s.name] || color || ink, width, dash, points, value };
  };
  const series = [{ label }, ...spec.series.map(line)];
  const axis = { stroke: ink, grid: { stroke: faint, width: 1 }, ticks: { stroke: faint, width: 1 } };
  const options = {
    width: box.clientWidth, height: HEIGHT, series,
    scales: { x: { time: false }, y: { range: rangeOfValues(() => ended(spec), spec.limits) } },
    axes: [{ ...axis, ...labelled, values: AXIS_OF_VALUES.values, label }, { ...axis, ...AXIS_OF_VALUES }],
    cursor: { sync: { key: "time" } },
    legend: { markers: { dash: (_, k) => (series[k].label === "set-point" ? "dotted" : series[k].dash ? "dashed" : "solid") } }, // names with the line that they name; values while the mouse is there
    hooks: { setCursor: [follow], setScale: [zoomAll], drawClear: [(chart) => bands(chart, spec)], draw: [(chart) => limits(chart, spec)] },
  };
  const chart = new uPlot(options, [DATA.time, ...spec.series.map((s) => s.values)], box);
  plots.push({ chart, box, spec });
}

// A chart is as wide as its box, also after the box was hidden. The next frame, because a new size inside the callback starts it anew.
const fit = () => requestAnimationFrame(() => {
  for (const { chart, box } of plots)
    if (box.clientWidth && box.clientWidth !== chart.width) chart.setSize({ width: box.clientWidth, height: HEIGHT });
});

function show() {
  for (const { chart, box, spec } of plots) {
    if (spec.only) box.hidden = !shown.has(spec.only) || shown.size > 2;
    else spec.series.forEach((s, k) => s.name in colors && chart.setSeries(k + 1, { show: shown.has(s.name) }));
  }
}

function control(controller) {
  const label = element("label"), box = element("input", { type: "checkbox", checked: true });
  box.addEventListener("change", () => {
    box.checked ? shown.add(controller.name) : shown.delete(controller.name);
    show();
  });
  const swatch = element("span", { className: "swatch" });
  swatch.style.background = colors[controller.name];
  label.append(box, swatch, document.createTextNode(controller.name));
  document.getElementById("controllers").append(label);
  return { box, name: controller.name };
}

document.querySelectorAll(".moves").forEach((box, k) => {
  const spec = DATA.motions[k];
  spec.runs.forEach((run) => (run.color = colors[run.name]));
  players.push(play(box, spec, point));
});
const boxes = DATA.controllers.map(control);
DATA.charts.map(place).forEach(draw);
// Begin with the controllers of the verdict's first sentence, so that a diverged one does not set every scale.
if (DATA.begin.length) {
  shown.clear();
  for (const { box, name } of boxes) if ((box.checked = DATA.begin.includes(name))) shown.add(name);
}
show();
const observer = new ResizeObserver(fit);
plots.forEach(({ box }) => observer.observe(box));
