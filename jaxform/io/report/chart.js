// Diagrams: lines and clouds of points in SVG, with a reading under the pointer.

const WIDTH = 640,
  HEIGHT = 330,
  LEFT = 62,
  RIGHT = 16,
  TOP = 12,
  BOTTOM = 48;

function short(value, digits = 4) {
  return Number.isFinite(value) ? String(Number(value.toPrecision(digits))) : "–";
}

function drawn(parent, tag, attributes = {}, text = "") {
  const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
  set(node, attributes);
  if (text) node.textContent = text;
  parent.appendChild(node);
  return node;
}

function element(parent, tag, attributes = {}, text = "") {
  const node = document.createElement(tag);
  Object.assign(node, attributes);
  if (text) node.textContent = text;
  parent.appendChild(node);
  return node;
}

function ticks(low, high, wanted = 6) {
  const rough = (high - low) / wanted,
    power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].find((factor) => factor * power >= rough) * power,
    found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) found.push(k * step);
  return found;
}

function logarithmicTicks(low, high) {
  const found = [];
  for (let power = Math.floor(Math.log10(low)); power <= Math.ceil(Math.log10(high)); power++)
    for (const factor of high / low > 200 ? [1] : [1, 2, 5]) found.push(factor * 10 ** power);
  return found.filter((value) => value >= low * 0.999 && value <= high * 1.001);
}

// Draws a diagram; `visit` is called with a line and the number of its point that was clicked on, where it has places.
// Places along x that are `marked` have a line and words at its upper end.
function chart(parent, { title, x, y, series, zero, log, marked = [] }, visit) {
  const figure = element(element(parent, "section", { className: "card" }), "figure");
  element(figure, "h2", {}, title);
  const legend = element(figure, "div", { className: "legend" });
  const points = series.map(({ points }) => pairs(points, log)),
    all = points.flat();
  if (!all.length) return figure.parentNode.remove();
  const scale = scales(all, zero, log);
  const svg = drawn(figure, "svg", {
    class: "chart",
    viewBox: `0 0 ${WIDTH} ${HEIGHT}`,
    role: "img",
    "aria-label": title,
  });
  axes(svg, scale, x, y, log);
  marked.forEach(([place, words]) => markPlace(svg, scale, place, words));
  series.forEach((line, index) => {
    if (line.label) element(legend, "span", { className: line.role, style: hue(line) }, line.label);
    const group = drawn(svg, "g", { class: line.role, style: hue(line) });
    const places = points[index].map(([a, b, k]) => [scale.across(a).toFixed(1), scale.up(b).toFixed(1), k]);
    if (line.dots) drawn(group, "path", { class: "dots", d: places.map(([a, b]) => `M${a} ${b}h0`).join("") });
    else for (const piece of unbroken(places)) drawn(group, "polyline", { points: piece.join(" ") });
  });
  const marks = new Set();
  for (const { mark } of series) {
    if (!mark) continue;
    drawn(svg, "circle", { class: "thinnest", cx: scale.across(mark[0]), cy: scale.up(mark[1]), r: 5.5 });
    if (!marks.has(mark[2])) element(legend, "span", { className: "thinnest" }, `${mark[2]}: ${short(mark[1])} mm`);
    marks.add(mark[2]);
  }
  follow(svg, scale, series, points, [x, y].map(unit), visit);
}

// Pieces of a line between the points that it lacks.
function unbroken(places) {
  const pieces = [];
  let last = NaN;
  for (const [a, b, k] of places) {
    if (k !== last + 1) pieces.push([]);
    pieces[pieces.length - 1].push(`${a},${b}`);
    last = k;
  }
  return pieces;
}

function hue({ color }) {
  return color ? `--hue: ${color}` : "";
}

function markPlace(svg, scale, place, words) {
  const at = scale.across(place),
    left = place < (scale.left + scale.right) / 2;
  drawn(svg, "line", { class: "marked", x1: at, x2: at, y1: TOP, y2: HEIGHT - BOTTOM });
  const beside = { x: at + (left ? 5 : -5), y: TOP + 9, "text-anchor": left ? "start" : "end" };
  drawn(svg, "text", { class: "marked", ...beside }, `${words}: ${short(place)}`);
}

function pairs(values, log) {
  const found = [];
  for (let k = 0; k < values.length; k += 2)
    if (Number.isFinite(values[k]) && Number.isFinite(values[k + 1]) && !(log && values[k + 1] <= 0))
      found.push([values[k], values[k + 1], k / 2]);
  return found;
}

function scales(all, zero, log) {
  let [left, right, low, high] = [Infinity, -Infinity, Infinity, -Infinity];
  for (const [a, b] of all) {
    left = Math.min(left, a);
    right = Math.max(right, a);
    low = Math.min(low, b);
    high = Math.max(high, b);
  }
  if (right <= left) [left, right] = [left - 0.5, right + 0.5];
  const room = 0.06 * (high - low || Math.abs(high) || 1);
  [low, high] = log ? [low / 1.15, high * 1.15] : [zero && low >= 0 ? 0 : low - room, high + room];
  const bend = log ? Math.log : (value) => value;
  return {
    left,
    right,
    low,
    high,
    across: (a) => LEFT + ((a - left) / (right - left)) * (WIDTH - LEFT - RIGHT),
    up: (b) => HEIGHT - BOTTOM - ((bend(b) - bend(low)) / (bend(high) - bend(low))) * (HEIGHT - TOP - BOTTOM),
  };
}

function axes(svg, scale, x, y, log) {
  const bottom = HEIGHT - BOTTOM,
    middle = (TOP + bottom) / 2;
  for (const value of ticks(scale.left, scale.right, 7)) {
    const at = scale.across(value);
    drawn(svg, "line", { class: "grid", x1: at, x2: at, y1: TOP, y2: bottom });
    drawn(svg, "text", { x: at, y: bottom + 17, "text-anchor": "middle" }, short(value));
  }
  for (const value of log ? logarithmicTicks(scale.low, scale.high) : ticks(scale.low, scale.high)) {
    const at = scale.up(value);
    drawn(svg, "line", { class: "grid", x1: LEFT, x2: WIDTH - RIGHT, y1: at, y2: at });
    drawn(svg, "text", { x: LEFT - 7, y: at + 4, "text-anchor": "end" }, short(value));
  }
  drawn(svg, "path", { class: "axis", fill: "none", d: `M${LEFT} ${TOP}V${bottom}H${WIDTH - RIGHT}` });
  drawn(svg, "text", { x: (LEFT + WIDTH - RIGHT) / 2, y: HEIGHT - 8, "text-anchor": "middle" }, x);
  drawn(svg, "text", { x: 15, y: middle, "text-anchor": "middle", transform: `rotate(-90 15 ${middle})` }, y);
}

// Shows the point that is nearest to the pointer, and has it visited where it is clicked on.
function follow(svg, scale, series, points, units, visit) {
  const group = drawn(svg, "g", { visibility: "hidden" }),
    line = drawn(group, "line", { class: "cursor", y1: TOP, y2: HEIGHT - BOTTOM }),
    dot = drawn(group, "circle", { class: "focus", r: 5 }),
    words = drawn(group, "text", { class: "value" });
  if (series.some(({ places }) => places)) svg.classList.add("places");
  svg.addEventListener("pointerleave", () => set(group, { visibility: "hidden" }));
  svg.addEventListener("pointermove", (event) => {
    const [a, b, , index] = nearest(svg, scale, points, event),
      [cx, cy] = [scale.across(a), scale.up(b)],
      right = cx > WIDTH / 2;
    set(group, { visibility: "visible", class: series[index].role, style: hue(series[index]) });
    set(line, { x1: cx, x2: cx });
    set(dot, { cx, cy });
    set(words, { x: cx + (right ? -10 : 10), y: Math.max(cy - 10, TOP + 12), "text-anchor": right ? "end" : "start" });
    words.textContent = `${short(b)} ${units[1]} at ${short(a)} ${units[0]}`;
  });
  svg.addEventListener("click", (event) => {
    const [, , number, index] = nearest(svg, scale, points, event);
    if (series[index].places) visit(series[index], number);
  });
}

// The point that is nearest to the pointer, above all across: its values, its number, and that of its line.
function nearest(svg, scale, points, event) {
  const [px, py] = pointer(svg, event);
  let best = Infinity,
    found = null;
  points.forEach((some, index) => {
    for (const [a, b, number] of some) {
      const away = Math.hypot(scale.across(a) - px, 0.3 * (scale.up(b) - py));
      if (away >= best) continue;
      best = away;
      found = [a, b, number, index];
    }
  });
  return found;
}

// Where the pointer is in a diagram.
function pointer(svg, event) {
  const box = svg.getBoundingClientRect(),
    factor = WIDTH / box.width;
  return [(event.clientX - box.left) * factor, (event.clientY - box.top) * factor];
}

function set(node, attributes) {
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
}

function unit(label) {
  return (label.match(/\[(.*)\]/) || ["", ""])[1];
}
