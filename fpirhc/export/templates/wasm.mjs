// @title@ in WebAssembly. Made by fpirhc; names, units and start values are in `layout`.
//
//   import { load } from "./@name@.mjs";
//   const c = await load(bytes);                 // of @name@.wasm: fetch(...) in a browser, readFile in Node
//   const status = c.step(sample);               // numbers in the order of layout.inputs, the time first
//   c.command[0], c.trace[...], c.set("deformation.gain", -0.4)

export const layout = @layout@;

export class Controller {
  #exports;

  constructor(instance) {
    const e = (this.#exports = instance.exports);
    e._initialize?.();
    e.init();
    const view = (place, size) => new Float64Array(e.memory.buffer, place, size);
    this.inputs = view(e.inputs(), layout.inputs.length);
    this.command = view(e.command(), layout.command.length);
    this.memory = view(e.memory_of_controller(), layout.memory.length);
    this.trace = view(e.trace(), layout.trace.length);
    this.data = Object.fromEntries(@data@.map((name) => [name, view(e[name](), layout[name].length)]));
  }

  /** One control cycle: returns its status; `command` and `trace` have its numbers. */
  step(sample) {
    if (sample.length !== this.inputs.length)
      throw new RangeError(`a sample has ${this.inputs.length} numbers, those of layout.inputs; got ${sample.length}`);
    this.inputs.set(sample);
    return this.#exports.step();
  }

  /** Forget the past, and keep parameters and settings. */
  reset() {
    this.#exports.reset();
  }

  /** Put a setting in force from the next step on; false where it is not finite or outside its bounds. */
  set(path, value) {
    const which = Object.keys(layout.bounds).indexOf(path);
    if (which < 0) throw new RangeError(`no live setting '${path}'; there are: ${Object.keys(layout.bounds).join(", ") || "none"}`);
    return this.#exports.set(which, value) === 1;
  }
}

/** Make a controller of the bytes of @name@.wasm, or of a response of fetch; every call makes one more. */
export async function load(source) {
  const bytes = source instanceof Response ? await source.arrayBuffer() : source;
  const { instance } = await WebAssembly.instantiate(bytes, {});
  return new Controller(instance);
}
