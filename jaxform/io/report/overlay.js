// What lies over the picture: labels of the axes, pins, what was picked, and the colour bar.

class Overlay {
  constructor(view, points) {
    Object.assign(this, { view, points, pins: [], crossed: false });
  }

  // Draws all anew. Marks are places in panes, by their number; pins are in the last pane, where they are wanted.
  draw(marks, pinned) {
    const { view } = this,
      overlay = get("overlay"),
      last = view.panes[view.panes.length - 1];
    overlay.replaceChildren();
    for (const pane of view.panes) {
      if (view.panes.length > 1) put(overlay, "pane", pane.part.label, pane.seen.left + pane.seen.width / 2);
      this.axisLabels(overlay, pane);
    }
    const shown = pinned ? this.points.filter(({ formed }) => !formed.includes(null)) : [];
    this.pins = shown.map(({ formed, name, number }) => {
      const [x, y] = view.project(formed, last);
      return { formed, node: put(overlay, name === "thinnest" ? "pin thin" : "pin", String(number), x, y) };
    });
    for (const { pane, point } of marks)
      put(overlay, "picked", "", ...view.project(point, view.panes[pane]).slice(0, 2));
    if (this.crossed) put(overlay, "cross", "", last.seen.left + last.seen.width / 2, last.seen.height / 2);
  }

  // Names each axis at the edge of the box that is lowest in the picture, the upright one at its left.
  axisLabels(overlay, pane) {
    const { view } = this,
      middle = view.project(view.center, pane);
    for (let axis = 0; axis < 3; axis++) {
      const edges = view.edges.filter(([a, b]) => a[axis] !== b[axis]);
      const lines = edges.map((ends) => ends.map((end) => view.project(end, pane)));
      const rank = (line) => (axis === 2 ? -(line[0][0] + line[1][0]) : line[0][1] + line[1][1]);
      const line = lines.sort((one, other) => rank(other) - rank(one))[0];
      if (!line || Math.hypot(line[0][0] - line[1][0], line[0][1] - line[1][1]) < 50) continue;
      const half = [0, 1].map((k) => (line[0][k] + line[1][k]) / 2);
      const out = unitVector([half[0] - middle[0], half[1] - middle[1], 0]);
      // The ends a little towards the middle, so that those of two axes do not meet.
      const towards = (end) => [0, 1].map((k) => end[k] + 0.12 * (half[k] - end[k]));
      const named = (text, [x, y], away) => {
        const { left, width } = pane.seen;
        put(overlay, "", text, clamp(x + away * out[0], left + 24, left + width - 24), y + away * out[1]);
      };
      [0, 1].forEach((end) => named(millimetres(view.box[end][axis], 3), towards(line[end]), 14));
      named(`${"xyz"[axis]} [mm]`, half, 18);
    }
  }

  // Pins of places that the part hides become faint.
  hideBehind() {
    const { view } = this,
      pane = view.panes[view.panes.length - 1];
    view.layout();
    for (const { formed, node } of this.pins) {
      const [x, y, depth] = view.project(formed, pane),
        found = view.pick(x, y);
      if (!found) continue;
      const place = inImage(found.image, found.pane.part.at(found.element, found.shares).formed);
      node.classList.toggle("behind", view.project(place, pane)[2] < depth - 0.02 * view.radius);
    }
  }
}

// The colours of a quantity with numbers beside them: the thinnest wall, and the value that was picked.
function colorBar({ low, high, label, unit, key, names }, { thinnest, thickest }, picked, gaps) {
  const bar = get("bar"),
    box = bar.querySelector(".ticks"),
    span = high - low,
    isWall = key === "thickness",
    thin = isWall ? MM * thinnest : NaN,
    more = isWall && MM * thickest > 1.001 * high;
  bar.querySelector("b").textContent = unit ? `${label} [${unit}]` : label;
  bar.querySelector("i").style.background = gradient("top");
  bar.querySelector("em").textContent = gaps ? "grey: free, or held from the start" : "";
  box.replaceChildren();
  if (names) return nameColors(bar, names);
  const tick = (value, text, kind) => {
    element(box, "span", { className: kind }, text).style.bottom = `${100 * clamp((value - low) / span, 0, 1)}%`;
  };
  const apart = (value, other) => !(Math.abs(value - other) < 0.07 * span);
  for (const value of ticks(low, high, 5))
    if (apart(value, thin) && (!more || apart(value, high))) tick(value, short(value, 3), "");
  if (more) tick(high, `${short(high, 3)} and more`, "");
  if (Number.isFinite(thin)) tick(thin, `thinnest ${short(thin, 3)}`, "thin");
  if (Number.isFinite(picked)) tick(picked, "", "here");
}

// A block of colour with its name for each of a few values: 0, 1, ...
function nameColors(bar, names) {
  const colors = mapColors(Math.max(names.length, 2)),
    blocks = names.map((_, k) => {
      const color = `rgb(${colors.subarray(4 * k, 4 * k + 3).join()})`;
      return `${color} ${(100 * k) / names.length}% ${(100 * (k + 1)) / names.length}%`;
    });
  bar.querySelector("i").style.background = `linear-gradient(to top, ${blocks.join()})`;
  names.forEach((name, k) => {
    element(bar.querySelector(".ticks"), "span", {}, name).style.bottom = `${(100 * (k + 0.5)) / names.length}%`;
  });
}

function inImage({ flip, shift }, place) {
  return place.map((value, axis) => flip[axis] * value + shift[axis]);
}

function put(overlay, kind, text, x, y) {
  const node = element(overlay, "span", { className: kind }, text);
  node.style.left = `${x}px`;
  if (y !== undefined) node.style.top = `${y}px`;
  return node;
}

function clamp(value, low, high) {
  return Math.min(Math.max(value, low), high);
}
