// Plays a mechanism: a panel per controller, pale lines where the reference wants it. It never starts by itself where motion is reduced.
function play(host, spec, onTime = () => {}, start = false) {
  const make = (tag, more = {}, ...inside) => {
    const one = Object.assign(document.createElement(tag), more);
    one.append(...inside);
    return one;
  };
  const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
  const panels = make("div", { className: "panels" });
  const button = make("button", { type: "button", textContent: "Play" });
  const slider = make("input", { type: "range", min: 0, max: 1000, step: 1, value: 0 }), clock = make("output");
  slider.setAttribute("aria-label", spec.title + ": time");
  host.append(make("div", { className: "motion" }, panels, make("div", { className: "bar" }, button, slider, clock)));
  let runs = [], shown = [], edges = null, time = 0, playing = false, asked = false, before = 0;

  // Numbers of a run in a frame; the lab has all of them, a report those that move.
  const frames = (run) => run.numbers.length / (run.moves ? run.moves.length || 1 : run.width);
  function numbers(run, frame) {
    if (!run.moves) return run.numbers.subarray(frame * run.width, (frame + 1) * run.width);
    const all = run.still.slice(), count = run.moves.length;
    run.moves.forEach((place, k) => (all[place] = run.numbers[frame * count + k]));
    return all;
  }
  // What a run that diverges does in its last frames sets no scale.
  function scale() {
    const low = [Infinity, Infinity], high = [-Infinity, -Infinity];
    for (const run of runs) {
      const count = frames(run), few = Array.from({ length: Math.min(count, 60) }, (_, k, n = Math.min(count, 60)) => numbers(run, Math.floor((k * count) / n)));
      let at = 0;
      for (const { points, disc } of spec.shapes) {
        for (let k = 0; k < 2 * points; ++k) {
          const sorted = few.map((one) => one[at + k]).sort((a, b) => a - b), radius = disc ? few[0][at + 2] : 0;
          low[k % 2] = Math.min(low[k % 2], sorted[Math.floor(0.03 * (sorted.length - 1))] - radius);
          high[k % 2] = Math.max(high[k % 2], sorted[Math.ceil(0.97 * (sorted.length - 1))] + radius);
        }
        at += 2 * points + (disc ? 1 : 0);
      }
    }
    edges = { low, high };
  }

  function outline(ctx, all, begin, place, unit, tone) {
    let at = begin;
    for (const { points, disc, closed } of spec.shapes) {
      ctx.beginPath();
      if (disc) ctx.arc(...place(all[at], all[at + 1]), Math.max(all[at + 2] * unit, 1), 0, 2 * Math.PI);
      else for (let k = 0; k < points; ++k) ctx[k ? "lineTo" : "moveTo"](...place(all[at + 2 * k], all[at + 2 * k + 1]));
      if (closed) ctx.closePath();
      ctx.globalAlpha = tone.fill;
      if (disc || closed) ctx.fill();
      ctx.globalAlpha = tone.line;
      ctx.stroke();
      at += 2 * points + (disc ? 1 : 0);
    }
  }

  function draw() {
    asked = false;
    const ink = getComputedStyle(host).color, dense = devicePixelRatio || 1;
    slider.value = Math.round((1000 * time) / spec.duration);
    clock.textContent = time.toFixed(2) + " " + spec.unit;
    slider.setAttribute("aria-valuetext", clock.textContent);
    runs.forEach((run, k) => {
      const canvas = shown[k], width = canvas.clientWidth, height = canvas.clientHeight;
      if (!width) return;
      Object.assign(canvas, { width: width * dense, height: height * dense });
      const ctx = canvas.getContext("2d"), { low, high } = edges;
      const unit = Math.min((width - 24) / (high[0] - low[0] || 1), (height - 16) / (high[1] - low[1] || 1));
      const place = (x, y) => [width / 2 + unit * (x - (low[0] + high[0]) / 2), height / 2 - unit * (y - (low[1] + high[1]) / 2)];
      const last = frames(run) - 1, all = numbers(run, Math.max(0, Math.min(last, Math.round(time / run.step))));
      ctx.scale(dense, dense);
      Object.assign(ctx, { lineWidth: 1, strokeStyle: ink, fillStyle: ink, lineJoin: "round" });
      if (all.length > spec.width) outline(ctx, all, spec.width, place, unit, { fill: 0.08, line: 0.35 });
      Object.assign(ctx, { lineWidth: 1.8, strokeStyle: run.color || ink, fillStyle: run.color || ink });
      outline(ctx, all, 0, place, unit, { fill: 0.35, line: 1 });
      if (time > run.step * (last + 1.5)) {
        Object.assign(ctx, { globalAlpha: 1, fillStyle: ink });
        ctx.fillText("ended at " + (run.step * (last + 1)).toPrecision(3) + " " + spec.unit, 8, height - 8);
      }
    });
  }
  const ask = () => asked || ((asked = true), requestAnimationFrame(draw));
  function go(to, told = true) {
    time = Math.min(Math.max(to, 0), spec.duration);
    if (told) onTime(time);
    ask();
  }
  function step(now) {
    if (!playing) return;
    const next = time + (((now - before) / 1000) * spec.duration) / spec.seconds;
    before = now;
    go(next >= spec.duration ? 0 : next);
    requestAnimationFrame(step);
  }
  function run(on) {
    playing = on;
    button.textContent = on ? "Pause" : "Play";
    before = performance.now();
    if (on) requestAnimationFrame(step);
  }
  button.addEventListener("click", () => run(!playing));
  slider.addEventListener("input", () => (run(false), go((spec.duration * slider.value) / 1000)));
  new ResizeObserver(ask).observe(panels);

  const player = {
    follow: (to) => playing || go(to, false), // the cursor of a chart
    load(given) {
      if (given.length !== runs.length)
        shown = given.map((one) => {
          const canvas = make("canvas"), name = make("span", { textContent: one.name });
          canvas.setAttribute("role", "img");
          canvas.setAttribute("aria-label", spec.title + ", " + one.name);
          panels.append(make("div", { className: "panel" }, name, canvas));
          return canvas;
        });
      runs = given;
      scale();
      ask();
    },
    get time() { return time; },
    get playing() { return playing; },
  };
  if (spec.runs) player.load(spec.runs);
  if (start && !calm) run(true);
  return player;
}
