// node replay.mjs: replays samples.bin, faults included, and compares commands with those of Python to 1e-9 of their size.
import { readFileSync } from "node:fs";
import { layout, load } from "./@name@.mjs";

const here = new URL(".", import.meta.url);
const file = readFileSync(process.argv[2] ?? new URL("samples.bin", here));
const view = new DataView(file.buffer, file.byteOffset, file.byteLength);
const controller = await load(readFileSync(new URL("@name@.wasm", here)));
const [cycles, inputs, commands] = [0, 4, 8].map((at) => view.getInt32(at, true));
const statuses = {}, bits = new DataView(new ArrayBuffer(8)), MASK = (1n << 64n) - 1n;
let at = 16, worst = 0, largest = 0, answers = 0xcbf29ce484222325n;
const next = () => view.getFloat64((at += 8) - 8, true);
for (let k = 0; k < cycles; ++k) {
  const sample = Float64Array.from({ length: inputs }, next), damaged = next();
  if (damaged >= 0) controller.memory[damaged] = NaN;
  const status = controller.step(sample);
  statuses[status] = (statuses[status] ?? 0) + 1;
  for (const value of controller.command) {
    const expected = next();
    worst = Math.max(worst, Math.abs(value - expected)), largest = Math.max(largest, Math.abs(expected));
    bits.setFloat64(0, value);
    answers = ((answers ^ bits.getBigUint64(0)) * 0x100000001b3n) & MASK;
  }
  at += 16; // hashes of memory and trace
}
if (layout.command.length !== commands) throw new Error("samples.bin is that of another controller");
console.log(`${cycles} cycles: command off by at most ${worst.toPrecision(3)} of ${largest.toPrecision(3)}`);
console.log(`answers ${answers.toString(16).padStart(16, "0")}`);
console.log(`statuses: ${Object.entries(statuses).map(([s, n]) => `${s} (${n} cycles)`).join(" ")}`);
process.exit(worst <= 1e-9 * largest ? 0 : 1);
