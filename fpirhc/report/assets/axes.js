"use strict";
// The axis of values of a chart: digits that tell its ticks apart, powers of ten where numbers are long, whatever the browser's language.
const isPlain = (size) => size < 1e6 && size >= 1e-3;
const power = (v, digits) => v.toExponential(digits).replace("e+", "e");
const numberText = (v) => (v === 0 || isPlain(Math.abs(v)) ? String(+v.toPrecision(4)) : power(v, 3));
function tickTexts(splits) {
  const step = Math.abs(splits[1] - splits[0]), largest = Math.max(...splits.map(Math.abs));
  if (!(step > 0) || !isFinite(largest)) return splits.map((v) => String(+v.toPrecision(3)));
  let decimals = -Math.floor(Math.log10(step) + 1e-9);
  if (Math.abs(+(step * 10 ** decimals).toFixed(6) % 1) > 1e-6) decimals += 1; // steps of 2.5
  return splits.map((v) => {
    if (Math.abs(v) < 1e-6 * step) return "0";
    if (isPlain(largest)) return v.toFixed(Math.max(0, decimals));
    const digits = Math.max(0, decimals + Math.floor(Math.log10(Math.abs(v)) + 1e-9));
    return power(v, Math.min(digits, 15));
  });
}
const AXIS_OF_VALUES = {
  values: (_, splits) => (splits.length > 1 ? tickTexts(splits) : splits.map((v) => String(+v.toPrecision(6)))),
  size: (_, texts) => Math.max(62, 16 + 7.5 * Math.max(0, ...(texts ?? []).map((text) => (text ?? "").length))),
};

// The range of values of a chart: where a run that ended early is shown whole, what it reached at last does not hide the rest.
// A limit is in it where the lines come near, so that a far one flattens no chart.
const TALL = 20, NEAR = 1.3; // largest size that is shown, over the usual one; range with a limit, over that of the lines
function rangeOfValues(ended, limits = []) {
  return (chart, low, high) => {
    if (low === null) return [0, 1];
    const [times] = chart.data, last = times[times.length - 1], { min, max } = chart.scales.x;
    if (ended(chart) && (min ?? times[0]) <= times[0] && (max ?? last) >= last) { // null: before the first drawing
      const sizes = chart.data.slice(1).flatMap((one, k) => (chart.series[k + 1].show ? one.filter((v) => v !== null).map(Math.abs) : []));
      const most = TALL * sizes.sort((a, b) => a - b)[sizes.length >> 1];
      if (most > 0) [low, high] = [Math.max(low, -most), Math.min(high, most)];
    }
    const near = limits.filter((v) => v !== null && Math.max(v, high) - Math.min(v, low) <= NEAR * (high - low));
    return uPlot.rangeNum(Math.min(low, ...near), Math.max(high, ...near), 0.1, true);
  };
}
