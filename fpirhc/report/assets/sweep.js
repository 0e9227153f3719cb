"use strict";
// The cell of a map: its number and the command of its run, for the cell that is pointed at in the picture or chosen. SWEEP is written by the page.
const picture = document.querySelector("#map img");
const box = document.getElementById("cell");

function choice(label, texts) {
  const field = document.createElement("label");
  const list = document.createElement("select");
  for (const text of texts) list.add(new Option(text));
  list.addEventListener("change", show);
  field.append(label + " ", list);
  box.append(field, " ");
  return list;
}

const law = choice("controller", SWEEP.maps.map((map) => map.controller));
const places = SWEEP.axes.map((axis) => choice(axis.path, axis.values));
const said = document.createElement("output");
const command = document.createElement("pre");
const copy = document.createElement("button");
command.className = "command";
copy.textContent = "copy the command";
box.append(said, command, copy);

function show() {
  const map = SWEEP.maps[law.selectedIndex];
  const cell = places.reduce((found, list) => found * list.length + list.selectedIndex, 0);
  said.textContent = map.cells[cell];
  const settings = SWEEP.axes.map((axis, k) => (map.without.includes(axis.path) ? "" : " --set " + axis.set[places[k].selectedIndex]));
  command.textContent = map.run + settings.join("") + SWEEP.seed;
}

const nearest = (centres, at) => centres.reduce((best, v, k) => (Math.abs(v - at) < Math.abs(centres[best] - at) ? k : best), 0);
picture.addEventListener("click", (event) => {
  const frame = picture.getBoundingClientRect();
  const at = [(event.clientX - frame.left) / frame.width, 1 - (event.clientY - frame.top) / frame.height];
  const panel = SWEEP.panels.findIndex((one) => one.low.every((low, k) => low <= at[k] && at[k] <= one.high[k]));
  if (panel < 0) return;
  if (panel < SWEEP.maps.length && SWEEP.panels.length > 1) law.selectedIndex = panel;
  places.forEach((list, k) => (list.selectedIndex = nearest(SWEEP.panels[panel].centres[k], at[k])));
  show();
});
copy.addEventListener("click", () => {
  getSelection().selectAllChildren(command);
  document.execCommand("copy");
});
picture.style.cursor = "crosshair";
show();
