// A map of a designed field over the sheet before it is formed, seen from above or unrolled about its axis, with a
// reading under the pointer.

const SHADES = 64;

function sheetMap(parent, { title, x, y, map, legend: note }, facts) {
  const figure = element(element(parent, "section", { className: "card" }), "figure");
  element(figure, "h2", {}, title);
  const legend = element(figure, "div", { className: "legend" }),
    ramp = element(legend, "span", { className: "ramp" }, `${map.words}: ${short(map.low, 3)}`);
  element(ramp, "i").style.background = gradient("right");
  ramp.append(short(map.high, 3));
  if (note) element(legend, "span", { className: "before" }, note);
  const svg = drawn(figure, "svg", {
    class: "chart map",
    viewBox: `0 0 ${WIDTH} ${HEIGHT}`,
    role: "img",
    "aria-label": `${title}: ${map.words}`,
  });
  const nodes = facts.array(map.triangles),
    points = facts.array(map.points),
    places = Array.from(nodes, (node) => [points[3 * node], points[3 * node + 1]]),
    values = Float64Array.from(nodes, (node) => points[3 * node + 2]),
    scale = map.angles ? scales(shownPart(places, map.angles), false, false) : evenScales(places),
    colors = mapColors(SHADES);
  axes(svg, scale, x, y, false);
  const field = map.angles ? cutout(svg, ...map.angles.map(scale.up)) : svg;
  shadesOf(values, map).forEach((elements, shade) => {
    if (!elements.length) return;
    const color = `rgb(${colors.subarray(4 * shade, 4 * shade + 3).join()})`;
    drawn(field, "path", { fill: color, stroke: color, d: elements.map((k) => outline(places, scale, k)).join("") });
  });
  readMap(svg, scale, places, values, unit(map.words), [x, y].map(unit));
}

// Places with the angles that are shown of a sheet, of which elements at the cut are drawn at both ends.
function shownPart(places, [least, most]) {
  return places.map(([a, b]) => [a, Math.min(Math.max(b, least), most)]);
}

// A group that is cut off below and above.
function cutout(svg, low, high) {
  const height = low - high;
  return drawn(svg, "svg", { x: 0, y: high, width: WIDTH, height, viewBox: `0 ${high} ${WIDTH} ${height}` });
}

// Axes with one unit of length along both, which the sheet fills along one of them.
function evenScales(places) {
  const found = scales(places, false, false),
    [wide, high] = [WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM],
    length = Math.max((found.right - found.left) / wide, (found.high - found.low) / high);
  const around = (low, top, size) => [(low + top - length * size) / 2, (low + top + length * size) / 2];
  const [[left, right], [low, top]] = [around(found.left, found.right, wide), around(found.low, found.high, high)];
  return {
    left,
    right,
    low,
    high: top,
    across: (a) => LEFT + (a - left) / length,
    up: (b) => HEIGHT - BOTTOM - (b - low) / length,
  };
}

// The elements of each shade, by the mean of their corners.
function shadesOf(values, { low, high }) {
  const found = Array.from({ length: SHADES }, () => []);
  for (let k = 0; k < values.length / 3; k++) {
    const mean = (values[3 * k] + values[3 * k + 1] + values[3 * k + 2]) / 3,
      shade = Math.floor((SHADES * (mean - low)) / (high - low || 1));
    if (Number.isFinite(mean)) found[Math.min(Math.max(shade, 0), SHADES - 1)].push(k);
  }
  return found;
}

function outline(places, scale, element) {
  const corners = [0, 1, 2].map((k) => places[3 * element + k]);
  return `M${corners.map(([a, b]) => `${scale.across(a).toFixed(1)} ${scale.up(b).toFixed(1)}`).join("L")}Z`;
}

// Shows the value of the node that is nearest to the pointer.
function readMap(svg, scale, places, values, of, units) {
  const group = drawn(svg, "g", { visibility: "hidden" }),
    dot = drawn(group, "circle", { class: "focus", r: 4 }),
    words = drawn(group, "text", { class: "value" });
  svg.addEventListener("pointerleave", () => set(group, { visibility: "hidden" }));
  svg.addEventListener("pointermove", (event) => {
    const [px, py] = pointer(svg, event);
    let [best, found] = [Infinity, 0];
    places.forEach(([a, b], k) => {
      const away = Math.hypot(scale.across(a) - px, scale.up(b) - py);
      if (away < best) [best, found] = [away, k];
    });
    const [cx, cy] = [scale.across(places[found][0]), scale.up(places[found][1])],
      right = cx > WIDTH / 2;
    set(group, { visibility: "visible" });
    set(dot, { cx, cy });
    set(words, { x: cx + (right ? -10 : 10), y: Math.max(cy - 10, TOP + 12), "text-anchor": right ? "end" : "start" });
    const [a, b] = places[found].map((place) => short(place)),
      where = units[0] === units[1] ? `(${a}, ${b}) ${units[0]}` : `${a} ${units[0]}, ${b} ${units[1]}`;
    words.textContent = `${short(values[found])} ${of} at ${where}`;
  });
}
