"use strict";
// Runs every loop from its start, with the numbers of the sliders in its memory.
let loops = [];

function bytes(text) {
  const raw = atob(text);
  return Uint8Array.from(raw, (c) => c.charCodeAt(0));
}

async function made(loop) {
  const { instance } = await WebAssembly.instantiate(bytes(loop.module), {});
  const e = instance.exports;
  if (e._initialize) e._initialize();
  const drawn = loop.tables.map((table) => new Float64Array(bytes(table).buffer));
  drawn.forEach((table, k) => new Float64Array(e.memory.buffer, e["table_" + k](), table.length).set(table));
  return { ...loop, drawn, exports: e };
}

function run(loop, numbers, parts) {
  const e = loop.exports, memory = new Float64Array(e.memory.buffer, e.memory_at(), loop.start.length);
  memory.set(loop.start);
  for (const { place, value } of numbers) memory[place] = value;
  for (const { table, column, first, last, scaled, value, ratio } of parts) {
    const drawn = loop.drawn[table], width = drawn.length / loop.cycles;
    const read = new Float64Array(e.memory.buffer, e["table_" + table](), drawn.length);
    for (let k = first * width + column; k < last * width; k += width) read[k] = scaled ? ratio * drawn[k] : value;
  }
  const began = performance.now(), cycles = e.run();
  const rows = Math.ceil(cycles / loop.every), width = loop.shown;
  const kept = new Float64Array(e.memory.buffer, e.kept_at(), rows * width);
  const columns = Array.from({ length: width }, (_, j) => Float64Array.from({ length: rows }, (_, k) => kept[k * width + j]));
  const squares = [...new Float64Array(e.memory.buffer, e.squares_at(), loop.errors)];
  const frames = loop.numbers ? new Float64Array(e.memory.buffer, e.frames_at(), Math.ceil(cycles / loop.frame) * loop.numbers).slice() : null;
  return { cycles, columns, squares, frames, frameWidth: loop.numbers, took: performance.now() - began };
}

onmessage = async ({ data }) => {
  try {
    if (data.loops) {
      loops = await Promise.all(data.loops.map(made));
      postMessage({ ready: true });
    } else postMessage({ number: data.number, answers: loops.map((loop, k) => run(loop, data.numbers[k], data.rows)) });
  } catch (error) {
    postMessage({ error: String(error) });
  }
};
