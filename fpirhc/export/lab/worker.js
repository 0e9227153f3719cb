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
  const began = performance.now(), cycles = e.run();
  const rows = Math.ceil(cycles / loop.every), width = loop.shown;
  const kept = new Float64Array(e.memory.buffer, e.kept_at(), rows * width);
  const columns = Array.from({ length: width }, (_, j) => Float64Array.from({ length: rows }, (_, k) => kept[k * width + j]));
  const squares = [...new Float64Array(e.memory.buffer, e.squares_at(), loop.errors)];
  return { cycles, columns, squares, ...seen(loop, Math.ceil(cycles / loop.frame)), took: performance.now() - began };
}

// Of every frame the numbers of the mechanism, and by how much an error of the response is multiplied in this cycle.
function seen(loop, count) {
  const numbers = loop.shapes + loop.responses ** 2;
  if (!numbers) return { frames: null, factors: null, frameWidth: 0 };
  const all = new Float64Array(loop.exports.memory.buffer, loop.exports.frames_at(), count * numbers);
  const frames = new Float64Array(count * loop.shapes), factors = loop.responses ? new Float64Array(count) : null;
  for (let k = 0; k < count; ++k) {
    const from = k * numbers, behind = from + loop.shapes;
    frames.set(all.subarray(from, behind), k * loop.shapes);
    if (factors) factors[k] = radius(Array.from(all.subarray(behind, from + numbers)), loop.responses);
  }
  return { frames, factors, frameWidth: loop.shapes };
}

// The spectral radius max|lambda| = lim |M^k|^(1/k) of an n x n matrix, by squares; 1 where an entry is no number, as nothing shrinks there.
function radius(matrix, n) {
  if (!matrix.every(Number.isFinite)) return 1;
  if (n === 1) return Math.abs(matrix[0]);
  let logarithm = 0, one = matrix;
  for (let power = 1; power <= 2 ** 40; power *= 2) {
    const size = Math.max(...one.map(Math.abs));
    if (!size) return 0;
    logarithm += Math.log(size) / power;
    const part = one.map((x) => x / size);
    one = part.map((_, at) => {
      let sum = 0;
      for (let j = 0; j < n; ++j) sum += part[(at % n) + n * j] * part[j + n * Math.floor(at / n)];
      return sum;
    });
  }
  return Math.exp(logarithm);
}

onmessage = async ({ data }) => {
  try {
    if (data.loops) {
      loops = await Promise.all(data.loops.map(made));
      postMessage({ ready: true });
    } else {
      const answers = loops.map((loop, k) => run(loop, data.numbers[k]));
      const arrays = answers.flatMap((one) => [...one.columns, one.frames, one.factors]).filter(Boolean);
      postMessage({ number: data.number, answers }, arrays.map((array) => array.buffer)); // handed over, not copied
    }
  } catch (error) {
    postMessage({ error: String(error) });
  }
};
