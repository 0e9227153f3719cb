// Boxes of a page that must not overlap: (names, pairs that overlap, boxes that stick out of their parent).
() => {
  const visible = (e) => !e.closest("[hidden]") && e.getClientRects().length > 0;
  const every = [...document.querySelectorAll("header, section, h2, h3, p, ul, figure, details, .scroll, #controllers, .chart, .u-wrap, .u-legend")];
  const shown = every.filter(visible);
  const name = (e) => `${e.tagName.toLowerCase()}.${e.className} ${(e.textContent || "").slice(0, 30)}`;
  const overlaps = [];
  shown.forEach((a, i) => {
    const one = a.getBoundingClientRect();
    for (const b of shown.slice(i + 1)) {
      if (a.contains(b) || b.contains(a) || a.closest(".scroll") || b.closest(".scroll")) continue;
      const two = b.getBoundingClientRect();
      const width = Math.min(one.right, two.right) - Math.max(one.left, two.left);
      const height = Math.min(one.bottom, two.bottom) - Math.max(one.top, two.top);
      if (width > 1 && height > 1) overlaps.push([name(a), name(b)]);
    }
  });
  const outside = shown
    .filter((e) => e.closest(".chart") && !e.matches(".chart"))
    .filter((e) => {
      const inner = e.getBoundingClientRect();
      const outer = e.closest(".chart").getBoundingClientRect();
      return inner.right > outer.right + 1 || inner.bottom > outer.bottom + 1 || inner.left < outer.left - 1;
    })
    .map(name);
  return { count: shown.length, charts: shown.filter((e) => e.matches(".chart")).length, overlaps, outside };
}
