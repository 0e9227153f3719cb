"use strict";
// Sliders, charts and the sentence; the loops run in a worker, and of the moves made while it runs only the last one is run.
const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const ink = style("--ink"), faint = style("--line");
const colors = DATA.loops.map((_, k) => (DATA.colors[k] === "#111111" ? ink : DATA.colors[k]));
const say = (id, text) => (document.getElementById(id).textContent = text);
const short = (value) => (value === 0 || (Math.abs(value) >= 1e-3 && Math.abs(value) < 1e5) ? String(+value.toPrecision(4)) : value.toExponential(2));
const quantity = (value, unit) => short(value) + (unit && unit !== "1" ? " " + unit : "");
const STEPS = 1000;

// A slider with one sign goes by equal ratios, another one by equal steps.
const ratio = (s) => s.low * s.high > 0;
const valueAt = (s, at) => (ratio(s) ? s.low * (s.high / s.low) ** (at / STEPS) : s.low + ((s.high - s.low) * at) / STEPS);
const atValue = (s, v) => Math.round(STEPS * (ratio(s) ? Math.log(v / s.low) / Math.log(s.high / s.low) : (v - s.low) / (s.high - s.low)));

const now = DATA.sliders.map((s) => s.value);
const rows = DATA.sliders.map((s, k) => {
  const label = document.createElement("label"), number = document.createElement("output"), input = document.createElement("input");
  Object.assign(input, { type: "range", min: 0, max: STEPS, step: 1 });
  input.setAttribute("aria-label", s.path);
  input.addEventListener("input", () => set(k, valueAt(s, +input.value)));
  label.append(s.path + " ", number, input);
  document.getElementById("sliders").append(label);
  return { label, number, input };
});

function set(k, value, run = true) {
  const s = DATA.sliders[k], { label, number, input } = rows[k];
  now[k] = Math.min(Math.max(value, Math.min(s.low, s.high)), Math.max(s.low, s.high));
  input.value = atValue(s, now[k]);
  input.setAttribute("aria-valuetext", quantity(now[k], s.unit));
  number.textContent = quantity(now[k], s.unit);
  label.classList.toggle("moved", now[k] !== s.value);
  if (run) changed();
}

// The worker: one run at a time.
const worker = new Worker(URL.createObjectURL(new Blob([DATA.worker], { type: "text/javascript" })));
let busy = false, waiting = false, sent = 0;
worker.onmessage = ({ data }) => {
  busy = false;
  if (data.ready) return changed();
  if (data.error) return say("sentence", "This page cannot run: " + data.error);
  window.answers = data.answers; // for who looks with the browser's tools
  window.shownNumber = data.number;
  draw(data.answers);
  if (waiting) changed();
};
function changed() {
  if (busy) return void (waiting = true);
  busy = true;
  waiting = false;
  const numbers = DATA.loops.map((_, j) => DATA.sliders.flatMap((s, k) => (now[k] === s.value ? [] : s.places[j].map((place) => ({ place, value: now[k] })))));
  worker.postMessage({ numbers, number: ++sent });
  remember();
}

// Charts
const charts = DATA.charts.map((spec) => {
  const box = document.createElement("div"), title = document.createElement("h3");
  box.className = "chart";
  title.textContent = spec.title + (spec.unit && spec.unit !== "1" ? ` [${spec.unit}]` : "");
  box.append(title);
  document.getElementById("charts").append(box);
  const lines = DATA.loops.map((loop, k) => ({ label: loop.name, stroke: colors[k], width: 1.3 }));
  if (spec.aims !== null) lines.push({ label: "reference", stroke: ink, dash: [5, 4], width: 1 });
  const axis = { stroke: ink, grid: { stroke: faint, width: 1 }, ticks: { stroke: faint, width: 1 } };
  const plot = new uPlot(
    { width: box.clientWidth || 400, height: 200, series: [{ label: "t [" + DATA.timeUnit + "]" }, ...lines], scales: { x: { time: false } },
      axes: [{ ...axis, label: "t [" + DATA.timeUnit + "]", size: 30, labelSize: 18 }, { ...axis, ...AXIS_OF_VALUES }], cursor: { sync: { key: "time" } } },
    [[], ...lines.map(() => [])], box);
  return { spec, box, plot };
});
new ResizeObserver(() => requestAnimationFrame(() => {
  for (const { box, plot } of charts) if (box.clientWidth && box.clientWidth !== plot.width) plot.setSize({ width: box.clientWidth, height: 200 });
})).observe(document.getElementById("charts"));

function draw(answers) {
  const longest = answers.reduce((a, b) => (b.columns[0].length > a.columns[0].length ? b : a));
  for (const { spec, plot } of charts) {
    const series = answers.map((one, k) => (spec.places[k] === null ? [] : one.columns[spec.places[k]]));
    if (spec.aims !== null) series.push(longest.columns[spec.aims]);
    plot.setData([longest.columns[0], ...series]);
  }
  say("sentence", verdict(answers));
}

// rms errors from the time on from which errors count
function verdict(answers) {
  const counted = DATA.cycles - Math.ceil(DATA.measured / DATA.period - 1e-9), specs = DATA.charts.filter((c) => c.error !== undefined);
  const texts = answers.map((one, k) => DATA.loops[k].name + (one.cycles < DATA.cycles ? " stops at " + short(one.cycles * DATA.period) + " " + DATA.timeUnit :
    " " + specs.map((c) => quantity(Math.sqrt(one.squares[c.error] / counted), c.unit)).join(", ")));
  return "rms error of " + specs.map((c) => c.title.slice(9)).join(", ") + ": " + texts.join("; ");
}

// The same in Python
function remember() {
  const moved = DATA.sliders.flatMap((s, k) => (now[k] === s.value ? [] : [[s.path, now[k]]]));
  const among = (test) => moved.filter(([p]) => test(p));
  const sides = /^(exact|approximate)\.(.*)/;
  const listed = (list) => "{" + list.map(([p, v]) => `"${p}": ${v}`).join(", ") + "}";
  const numbers = among((p) => sides.test(p)).map(([p, v]) => [p.replace(sides, "plant.parameters.$2.$1"), v]);
  const settings = among((p) => !sides.test(p));
  // Each loop as it was built for this page, and a run of it with other numbers; a controller that is built with them has another first
  // plan.
  const texts = DATA.loops.map((loop) => {
    const own = settings.filter(([p]) => loop.live.includes(p));
    const built = `task.problem, task.controllers[${JSON.stringify(loop.name)}]`;
    if (!numbers.length && !own.length) return [`print(fp.simulate(${built}, seed=0))`];
    const live = own.length ? `, live=${JSON.stringify(own.map(([p]) => p))}` : "";
    const variant = numbers.length ? `, variant=fp.with_settings(task.problem, ${listed(numbers)})` : "";
    const given = own.length ? `, settings=${listed(own)}` : "";
    return [`loop = fp.simulator(${built}${live})`, `print(loop.run(seed=0${variant}${given}))`];
  });
  const lines = ["import fpirhc as fp", "", `task = fp.load_problem(${JSON.stringify(DATA.file)})`, ...texts.flat()];
  say("python", lines.join("\n"));
}

document.getElementById("copy").addEventListener("click", () => navigator.clipboard?.writeText(document.getElementById("python").textContent));
document.getElementById("again").addEventListener("click", () => {
  DATA.sliders.forEach((s, k) => set(k, s.value, false));
  changed();
});
DATA.loops.forEach((loop, k) => {
  const label = document.createElement("label"), box = document.createElement("input"), swatch = document.createElement("span");
  Object.assign(box, { type: "checkbox", checked: true });
  swatch.className = "swatch";
  swatch.style.background = colors[k];
  box.addEventListener("change", () => charts.forEach(({ plot }) => plot.setSeries(k + 1, { show: box.checked })));
  label.append(box, swatch, loop.name);
  document.getElementById("controllers").append(label);
});
DATA.sliders.forEach((s, k) => set(k, s.value, false));
busy = true;
worker.postMessage({ loops: DATA.loops });
