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
  loop.tables.map((table) => new Float64Array(bytes(table).buffer)).forEach((table, k) => new Float64Array(e.memory.buffer, e["table_" + k](), table.length).set(table));
  return { ...loop, exports: e };
}

function run(loop, numbers) {
  const e = loop.exports, memory = new Float64Array(e.memory.buffer, e.memory_at(), loop.start.length);
  memory.set(loop.start);
  for (const { place, value } of numbers) memory[place] = value;
  const cycles = e.run();
  const rows = Math.ceil(cycles / loop.every), width = loop.shown;
  const kept = new Float64Array(e.memory.buffer, e.kept_at(), rows * width);
  const columns = Array.from({ length: width }, (_, j) => Float64Array.from({ length: rows }, (_, k) => kept[k * width + j]));
  const squares = [...new Float64Array(e.memory.buffer, e.squares_at(), loop.errors)];
  return { cycles, columns, squares };
}

onmessage = async ({ data }) => {
  try {
    if (data.loops) {
      loops = await Promise.all(data.loops.map(made));
      postMessage({ ready: true });
    } else {
      const answers = loops.map((loop, k) => run(loop, data.numbers[k]));
      const arrays = answers.flatMap((one) => one.columns);
      postMessage({ number: data.number, answers }, arrays.map((array) => array.buffer)); // handed over, not copied
    }
  } catch (error) {
    postMessage({ error: String(error) });
  }
};
