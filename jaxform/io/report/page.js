// The page: what is drawn, what is chosen, what is read.

const get = (id) => document.getElementById(id);
const MM = 1000, NONE = Math.fround(-1e30);

async function start() {
  const facts = await unpack(get("parcel").textContent);
  for (const { series } of facts.charts) for (const line of series) line.points = facts.array(line.points);
  facts.charts.forEach((described) => chart(get("charts"), described));
  const page = new Page(facts);
  page.begin();
  document.documentElement.dataset.ready = "yes";
}

class Page {
  constructor(facts) {
    this.facts = facts;
    this.quantity = facts.quantities[0];
    this.first = new Part(facts, 0);
    this.frames = facts.parts.map((part, number) => ({ ...part, number })).filter(({ label }) => label === "frame");
    this.picked = null;
  }

  begin() {
    const { facts } = this;
    this.view = new View(get("canvas"), facts);
    this.view.theme = theme();
    this.buildMold();
    this.choices();
    this.gestures();
    this.keys();
    this.show();
    new ResizeObserver(() => this.redraw()).observe(get("canvas"));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => ((this.view.theme = theme()), this.redraw()));
  }

  choices() {
    const { facts } = this, redo = () => this.show();
    facts.quantities.forEach(({ label, unit }, k) => element(get("quantity"), "option", { value: k }, unit ? `${label} [${unit}]` : label));
    get("choice-part").hidden = !facts.search;
    get("choice-whole").hidden = !Object.keys(facts.symmetry).length;
    get("choice-mold").hidden = !facts.mold;
    get("quantity").addEventListener("change", redo);
    get("shown").addEventListener("change", redo);
    for (const id of ["whole", "mold", "edges"]) get(id).addEventListener("change", () => this.settle());
    get("limit").addEventListener("input", () => this.settle());
    get("home").addEventListener("click", () => this.home());
    document.querySelectorAll("[data-point]").forEach((button) => button.addEventListener("click", () => this.visit(Number(button.dataset.point))));
    if (this.frames.length) this.player();
  }

  player() {
    const slider = get("frame"), last = this.frames.length;
    get("frames").hidden = false;
    if (this.facts.frame_count > last + 1) get("kept").textContent = `${last + 1} of ${this.facts.frame_count} frames`;
    Object.assign(slider, { max: last, value: last });
    slider.addEventListener("input", () => this.show());
    get("play").addEventListener("click", () => {
      clearInterval(this.playing);
      if (this.playing) return void ((this.playing = null), (get("play").textContent = "Play"));
      if (Number(slider.value) === last) slider.value = 0;
      get("play").textContent = "Pause";
      this.playing = setInterval(() => {
        slider.value = Number(slider.value) + 1;
        this.show();
        if (Number(slider.value) >= last) get("play").click();
      }, Math.max(3000 / last, 80));
    });
  }

  // Numbers of the parts that are shown, from left to right.
  wanted() {
    if (this.facts.search) return { both: [1, 0], best: [0], start: [1] }[get("shown").value];
    const frame = this.frames[Number(get("frame").value)];
    return [this.frames.length && frame ? frame.number : 0];
  }

  // Builds what is drawn of the parts.
  show() {
    const { view } = this;
    this.quantity = this.facts.quantities[Number(get("quantity").value)];
    const before = view.panes.map(({ part }) => part.prefix).join();
    view.panes.forEach(({ surface }) => view.release(surface));
    this.gaps = false;
    view.panes = this.wanted().map((number) => this.pane(number));
    if (before !== view.panes.map(({ part }) => part.prefix).join()) this.picked = null;
    get("time").textContent = `${short(view.panes[0].part.time)} s`;
    this.settle();
    this.read();
  }

  pane(number) {
    const part = number ? new Part(this.facts, number) : this.first, position = part.cornersOf(part.positions);
    const value = part.values(this.quantity).map((x) => (Number.isFinite(x) ? x : NONE));
    this.gaps ||= this.quantity.key === "contact_time" && value.includes(NONE);
    const wall = part.values(this.facts.quantities[0]);
    const normal = cornerNormals(position, part.nodes);
    return { part, surface: this.view.surface({ position, normal, value, wall }, 3 * part.count) };
  }

  buildMold() {
    const { facts, view } = this;
    if (!facts.mold) return;
    const [nodes, places] = [facts.array("mold.triangles"), facts.array("mold.positions")], position = new Float32Array(3 * nodes.length);
    for (let k = 0; k < position.length; k++) position[k] = places[3 * nodes[(k / 3) | 0] + (k % 3)];
    view.mold = view.surface({ position }, nodes.length);
    view.moldMirrored = facts.mold.mirrored;
  }

  // Takes over what is chosen without a new part.
  settle() {
    const { view, quantity } = this, limit = parseFloat(get("limit").value);
    Object.assign(view.options, { whole: get("whole").checked, mold: get("mold").checked, edges: get("edges").checked });
    Object.assign(view.options, { range: [quantity.low, quantity.high], limit: limit > 0 ? limit : -1 });
    get("below").textContent = limit > 0 ? `${short(100 * this.shareBelow(limit), 3)} % of the area` : "";
    this.frameBox();
    this.colorBar();
    this.redraw();
  }

  // The share of the area of the last part that was formed and is thinner than a limit [mm].
  shareBelow(limit) {
    const { part } = this.view.panes[this.view.panes.length - 1], walls = part.raw("thickness");
    let [below, all] = [0, 0];
    for (let k = 0; k < part.count; k++) {
      const [a, b, c] = [0, 1, 2].map((corner) => part.corner(part.positions, k, corner));
      const normal = cross(b.map((x, axis) => x - a[axis]), c.map((x, axis) => x - a[axis])), area = Math.hypot(...normal);
      all += area;
      if (MM * walls[k] < limit) below += area;
    }
    return below / (all || 1);
  }

  frameBox() {
    const { view } = this, low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    const images = view.images(view.options.whole);
    const take = (places) => {
      for (let k = 0; k < places.length; k++)
        for (const { flip, shift } of images) {
          const axis = k % 3, value = flip[axis] * places[k] + shift[axis];
          if (value < low[axis]) low[axis] = value;
          if (value > high[axis]) high[axis] = value;
        }
    };
    // The end's box for all frames, so that nothing jumps.
    take(this.first.positions);
    take(view.panes[0].part.positions);
    view.frame(low, high);
    this.edges = boxEdges(low, high);
    view.release(view.lines);
    view.lines = view.surface({ position: new Float32Array(this.edges.flat(2)) }, 2 * this.edges.length);
  }

  redraw() {
    if (this.waiting) return;
    this.waiting = requestAnimationFrame(() => {
      this.waiting = null;
      this.view.draw();
      this.labels();
      clearTimeout(this.resting);
      this.resting = setTimeout(() => this.hideBehind(), 120);
    });
  }

  home() {
    this.view.home();
    this.redraw();
  }

  // Labels and pins over the picture.
  labels() {
    const { view, facts } = this, overlay = get("overlay");
    overlay.replaceChildren();
    for (const pane of view.panes) {
      if (view.panes.length > 1) put(overlay, "pane", pane.part.label, pane.seen.left + pane.seen.width / 2);
      this.axisLabels(overlay, pane);
    }
    const last = view.panes[view.panes.length - 1];
    this.pins = [];
    if (last.part.number === 0 || last.part === this.first)
      this.pins = facts.points
        .map(({ formed, name }, k) => ({ pane: last, point: formed, number: String(k + 1), thin: name === "thinnest" }))
        .filter(({ point }) => !point.includes(null))
        .map((one) => ({ ...one, node: pin(overlay, last, view, one.point, one.number, one.thin) }));
    if (this.picked) for (const { pane, point } of this.picked.marks) if (view.panes.includes(pane)) pin(overlay, pane, view, point, "", false, "picked");
    if (this.crossed) for (const { seen } of [last]) put(overlay, "cross", "", seen.left + seen.width / 2, seen.height / 2);
  }

  axisLabels(overlay, pane) {
    const { view, edges } = this, middle = view.project(view.center, pane);
    for (let axis = 0; axis < 3; axis++) {
      const lines = edges.filter(([a, b]) => a[axis] !== b[axis]).map((ends) => ends.map((end) => view.project(end, pane)));
      const lowest = (line) => (axis === 2 ? -(line[0][0] + line[1][0]) : line[0][1] + line[1][1]);
      const line = lines.sort((one, other) => lowest(other) - lowest(one))[0];
      if (!line || Math.hypot(line[0][0] - line[1][0], line[0][1] - line[1][1]) < 50) continue;
      const [low, high] = view.box, middleOf = [0, 1].map((k) => (line[0][k] + line[1][k]) / 2);
      const out = unitVector([middleOf[0] - middle[0], middleOf[1] - middle[1], 0]);
      // The ends a little towards the middle, so that those of two axes do not meet.
      const towards = (end) => [0, 1].map((k) => end[k] + 0.12 * (middleOf[k] - end[k]));
      const words = [millimetres(low[axis], 3), millimetres(high[axis], 3)];
      [[towards(line[0]), words[0], 14], [towards(line[1]), words[1], 14], [middleOf, `${"xyz"[axis]} [mm]`, 18]].forEach(([[x, y], text, away]) =>
        put(overlay, "", text, clamp(x + away * out[0], pane.seen.left + 24, pane.seen.left + pane.seen.width - 24), y + away * out[1]));
    }
  }

  // Pins of places that the part hides become faint.
  hideBehind() {
    const { view } = this;
    for (const { pane, point, node } of this.pins || []) {
      const [x, y, depth] = view.project(point, pane), found = view.pick(x, y);
      if (!found) continue;
      const { part } = found.pane, { flip, shift } = found.image;
      const place = part.at(found.element, found.shares).formed.map((value, k) => flip[k] * value + shift[k]);
      node.classList.toggle("behind", view.project(place, pane)[2] < depth - 0.02 * view.radius);
    }
  }

  colorBar() {
    const { low, high, label, unit, key } = this.quantity, bar = get("bar"), thin = key === "thickness" ? MM * this.facts.thinnest : NaN;
    bar.querySelector("b").textContent = unit ? `${label} [${unit}]` : label;
    bar.querySelector("i").style.background = `linear-gradient(to top, ${VIRIDIS.map((hex) => `#${hex}`).join()})`;
    const box = bar.querySelector(".ticks"), span = high - low;
    box.replaceChildren();
    const tick = (value, text, kind) => {
      const at = Math.min(Math.max((value - low) / span, 0), 1);
      element(box, "span", { className: kind }, text).style.bottom = `${100 * at}%`;
    };
    bar.querySelector("em").textContent = this.gaps ? "grey: free, or held from the start" : "";
    const values = ticks(low, high, 5).filter((value) => !(Math.abs(value - thin) < 0.07 * span));
    const more = key === "thickness" && MM * this.facts.thickest > 1.001 * high;
    if (more) tick(high, `${short(high, 3)} and more`, "");
    values.filter((value) => !more || high - value > 0.07 * span).forEach((value) => tick(value, short(value, 3), ""));
    if (Number.isFinite(thin)) tick(thin, `thinnest ${short(thin, 3)}`, "thin");
    if (this.picked) {
      const value = this.valueAt(this.picked.reading);
      if (Number.isFinite(value)) tick(value, "", "here");
    }
  }

  valueAt(reading) {
    const { key, of, factor } = this.quantity;
    if (key === AREA_STRETCH) return reading.stretches[0] * reading.stretches[1];
    if (key === "contact_time") return touched(reading.times);
    return factor * (of === "nodes" ? reading.nodal(key) : reading.own(key));
  }

  read(found = null) {
    if (found) {
      const { pane, element: number, shares } = found, reading = pane.part.at(number, shares);
      const { flip, shift } = found.image, inImage = (place) => place.map((x, k) => flip[k] * x + shift[k]);
      this.picked = { reading, part: pane.part, marks: [{ pane, point: inImage(reading.formed) }] };
      this.compare(pane, reading, inImage);
    }
    const box = get("reading");
    if (!this.picked) return;
    box.replaceChildren();
    const list = element(box, "dl");
    for (const [name, value] of this.words()) {
      const row = element(list, "div");
      element(row, "dt", {}, name);
      element(row, "dd", {}, value);
    }
    box.dataset.thickness = this.picked.reading.thickness;
    box.dataset.element = this.picked.reading.element;
    box.dataset.place = this.picked.reading.formed.join();
    this.colorBar();
    this.redraw();
  }

  // The same place of the sheet in the part beside it.
  compare(pane, reading, inImage) {
    const other = this.view.panes.find((one) => one !== pane);
    if (!other) return;
    const number = other.part.find(reading.initial), beside = other.part.at(number, [1 / 3, 1 / 3, 1 / 3]);
    this.picked.beside = [other.part.label, beside.thickness];
    this.picked.marks.push({ pane: other, point: inImage(beside.formed) });
  }

  words() {
    const { reading, part, beside } = this.picked, [first, second] = reading.stretches;
    const mm = (place) => `${place.map((x) => millimetres(x, 4)).join(", ")} mm`;
    const found = [
      ["wall", `${short(MM * reading.thickness)} mm`],
      ["stretches", `${short(first)} × ${short(second)}`],
      ["area stretch", short(first * second)],
      ["place in the part (x, y, z)", mm(reading.formed)],
      ["it came from, in the sheet", mm(reading.initial)],
      ["touched", touchWords(reading.times)],
    ];
    const initial = reading.nodal("initial_thickness"), warm = reading.nodal("temperature");
    if (Number.isFinite(initial)) found.push(["initial thickness", `${short(MM * initial)} mm`]);
    if (Number.isFinite(warm)) found.push(["temperature of the sheet", `${short(warm)} °C`]);
    if (beside) found.push([`wall there, ${beside[0]}`, `${short(MM * beside[1])} mm`]);
    // Elements of a frame with a mesh of its own are in another order than in its file.
    const named = part.label !== "frame" || part.mesh === 0;
    found.push(named ? ["element in the file", `${reading.element}, level ${reading.level}`] : ["level", `${reading.level}`]);
    return this.view.panes.length > 1 ? [["part", part.label], ...found] : found;
  }

  // Turns the view to a place that is to be measured.
  visit(number) {
    if (this.facts.search && get("shown").value === "start") (get("shown").value = "best"), this.show();
    if (this.frames.length) (get("frame").value = this.frames.length), this.show();
    const { view } = this, pane = view.panes[view.panes.length - 1], point = this.facts.points[number];
    if (point.formed.includes(null)) return;
    const away = point.formed.map((x, k) => x - view.center[k]);
    view.azimuth = Math.atan2(away[1], away[0]);
    view.elevation = clamp(Math.atan2(view.up * away[2], Math.hypot(away[0], away[1])), -1.2, 1.2);
    const shares = [1 / 3, 1 / 3, 1 / 3], element = number === 0 ? pane.part.find(point.initial) : point.element;
    this.read({ pane, element, shares, image: view.images(false)[0] });
    get("stage").scrollIntoView({ behavior: matchMedia("(prefers-reduced-motion: reduce)").matches ? "auto" : "smooth", block: "start" });
  }

  turn(x, y) {
    const { view } = this;
    view.azimuth -= view.up * x;
    view.elevation = clamp(view.elevation + y, -1.57, 1.57);
    this.redraw();
  }

  zoom(factor) {
    this.view.zoom = clamp(this.view.zoom * factor, 0.2, 60);
    this.redraw();
  }

  move(x, y) {
    const { view } = this, scale = 2 / (view.canvas.clientHeight * view.zoom);
    view.pan[0] += x * scale;
    view.pan[1] -= y * scale;
    this.redraw();
  }

  gestures() {
    const canvas = get("canvas"), down = new Map();
    let moved = 0;
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => (event.preventDefault(), this.zoom(Math.exp(-0.0015 * event.deltaY))), { passive: false });
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      down.set(event.pointerId, [event.clientX, event.clientY]);
      if (down.size === 1) moved = 0;
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = down.get(event.pointerId);
      if (!before) return;
      const [x, y] = [event.clientX - before[0], event.clientY - before[1]];
      const span = () => Math.hypot(...[0, 1].map((k) => [...down.values()][0][k] - [...down.values()][1][k]));
      const old = down.size === 2 ? span() : 0;
      down.set(event.pointerId, [event.clientX, event.clientY]);
      moved += Math.abs(x) + Math.abs(y);
      if (down.size === 2) this.zoom(span() / (old || 1)), this.move(x / 2, y / 2);
      else if (event.shiftKey || event.buttons & 6) this.move(x, y);
      else if (moved > 4) this.turn(0.008 * x, 0.008 * y);
    });
    const end = (event) => {
      const click = down.size === 1 && moved <= 4 && event.type === "pointerup" && event.button === 0;
      down.delete(event.pointerId);
      if (!click) return;
      const box = canvas.getBoundingClientRect(), found = this.view.pick(event.clientX - box.left, event.clientY - box.top);
      if (found) this.read(found);
    };
    canvas.addEventListener("pointerup", end);
    canvas.addEventListener("pointercancel", end);
  }

  keys() {
    const canvas = get("canvas");
    const actions = {
      ArrowLeft: () => this.turn(-0.12, 0), ArrowRight: () => this.turn(0.12, 0), ArrowUp: () => this.turn(0, -0.12), ArrowDown: () => this.turn(0, 0.12),
      "+": () => this.zoom(1.15), "=": () => this.zoom(1.15), "-": () => this.zoom(1 / 1.15), 0: () => this.home(), Home: () => this.home(),
      Enter: () => this.readMiddle(),
    };
    canvas.addEventListener("keydown", (event) => {
      const action = !(event.ctrlKey || event.metaKey || event.altKey) && actions[event.key];
      if (!action) return;
      event.preventDefault();
      action();
    });
    canvas.addEventListener("focus", () => ((this.crossed = canvas.matches(":focus-visible")), this.redraw()));
    canvas.addEventListener("blur", () => ((this.crossed = false), this.redraw()));
  }

  readMiddle() {
    const { seen } = this.view.panes[this.view.panes.length - 1], found = this.view.pick(seen.left + seen.width / 2, seen.height / 2);
    if (found) this.read(found);
  }
}

// A place [m] in mm; what is below a millionth of a mm is rounding.
function millimetres(value, digits) {
  return short(Math.round(1e9 * value) / 1e6 + 0, digits);
}

function clamp(value, low, high) {
  return Math.min(Math.max(value, low), high);
}

// When an element touched [s]: since its last corner; NaN where it does not, or was held from the start.
function touched(times) {
  const last = Math.max(...times);
  return last > 0 ? last : NaN;
}

function touchWords(times) {
  const known = times.filter((time) => Number.isFinite(time));
  if (known.length < 3) return known.length ? "only some of its corners" : "not";
  return Math.max(...times) > 0 ? `at ${short(Math.max(...times))} s` : "held from the start";
}

function boxEdges(low, high) {
  const ends = [low, high], found = [];
  for (let axis = 0; axis < 3; axis++)
    for (let k = 0; k < 4; k++) {
      const [one, other] = [0, 1, 2].filter((other) => other !== axis), corner = [0, 0, 0];
      corner[one] = ends[k & 1][one];
      corner[other] = ends[k >> 1][other];
      found.push(ends.map((end) => corner.map((value, place) => (place === axis ? end[axis] : value))));
    }
  return found;
}

function put(overlay, kind, text, x, y) {
  const node = element(overlay, "span", { className: kind }, text);
  node.style.left = `${x}px`;
  if (y !== undefined) node.style.top = `${y}px`;
  return node;
}

function pin(overlay, pane, view, point, text, thin, kind = "pin") {
  const [x, y] = view.project(point, pane);
  return put(overlay, thin ? `${kind} thin` : kind, text, x, y);
}

function theme() {
  const style = getComputedStyle(document.documentElement), color = (name) => rgb(style.getPropertyValue(name).trim().slice(1));
  const dark = matchMedia("(prefers-color-scheme: dark)").matches;
  return { stage: color("--stage"), line: dark ? [90, 98, 110] : [176, 184, 194], mold: dark ? [190, 198, 210] : [90, 100, 115] };
}

start().catch((error) => {
  const problem = get("problem");
  problem.hidden = false;
  for (const part of [get("bar"), ...document.querySelectorAll("#stage .tools, #reading")]) part.hidden = true;
  problem.textContent = `The part cannot be drawn here (${error.message}). It needs a browser with WebGL2 and DecompressionStream: any since 2023. The tables on this page are complete.`;
  document.documentElement.dataset.ready = "no";
});
