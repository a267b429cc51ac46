// The page: what is drawn, what is chosen, what is read.

const get = (id) => document.getElementById(id);
const NONE = Math.fround(-1e30);

async function start() {
  const facts = await unpack(get("parcel").textContent);
  for (const { series } of facts.charts) for (const line of series) line.points = facts.array(line.points);
  const page = new Page(facts);
  for (const described of facts.charts)
    if (described.map) sheetMap(get("charts"), described, facts);
    else chart(get("charts"), described, (line, number) => page.follow(line, number));
  page.begin();
  document.documentElement.dataset.ready = "yes";
}

class Page {
  constructor(facts) {
    this.facts = facts;
    this.first = new Part(facts, 0);
    this.frames = facts.parts.flatMap(({ label }, number) => (label === "frame" ? [number] : []));
    this.picked = null;
    this.hint = get("reading").firstElementChild;
    facts.points.forEach((point, k) => (point.number = k + 1));
  }

  begin() {
    const { facts } = this,
      canvas = get("canvas"),
      redraw = () => this.redraw();
    this.view = new View(canvas, facts);
    this.view.theme = theme();
    this.overlay = new Overlay(this.view, facts.points);
    this.controls = new Controls(this.view, redraw, (found) => this.read(found));
    this.buildMold();
    this.choices();
    this.show();
    new ResizeObserver(redraw).observe(canvas);
    for (const name of ["focus", "blur"])
      canvas.addEventListener(name, () => {
        this.overlay.crossed = canvas.matches(":focus-visible");
        redraw();
      });
    canvas.addEventListener("webglcontextlost", () => complain("the graphics card lost its memory; reload the page"));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
      this.view.theme = theme();
      redraw();
    });
  }

  choices() {
    const { facts } = this;
    facts.quantities.forEach(({ label, unit }, k) =>
      element(get("quantity"), "option", { value: k }, unit ? `${label} [${unit}]` : label),
    );
    get("choice-part").hidden = !facts.search;
    get("choice-whole").hidden = !Object.keys(facts.symmetry).length;
    get("choice-mold").hidden = !facts.mold && !facts.tools.length;
    if (facts.tools.length) get("choice-mold").lastChild.textContent = facts.mold ? " mold and tools" : " tools";
    for (const id of ["quantity", "shown"]) get(id).addEventListener("change", () => this.show());
    for (const id of ["whole", "mold", "edges"]) get(id).addEventListener("change", () => this.settle());
    get("limit").addEventListener("input", () => this.settle());
    get("home").addEventListener("click", () => this.controls.home());
    for (const button of document.querySelectorAll("[data-point]"))
      button.addEventListener("click", () => this.visit(facts.points[Number(button.dataset.point)]));
    if (this.frames.length) this.player();
  }

  player() {
    const slider = get("frame"),
      last = this.frames.length;
    get("frames").hidden = false;
    if (this.facts.frame_count > last + 1) get("kept").textContent = `${last + 1} of ${this.facts.frame_count} frames`;
    Object.assign(slider, { max: last, value: last });
    slider.addEventListener("input", () => this.show());
    get("play").addEventListener("click", () => {
      if (this.playing) return this.pause();
      if (Number(slider.value) === last) slider.value = 0;
      get("play").textContent = "Pause";
      this.playing = setInterval(() => this.step(), Math.max(3000 / last, 80));
    });
  }

  step() {
    const slider = get("frame");
    slider.value = Number(slider.value) + 1;
    this.show();
    if (slider.value === slider.max) this.pause();
  }

  pause() {
    clearInterval(this.playing);
    this.playing = null;
    get("play").textContent = "Play";
  }

  // Numbers of the parts that are shown, from left to right.
  wanted() {
    if (this.facts.search) return { both: [1, 0], best: [0], start: [1] }[get("shown").value];
    return [this.frames[Number(get("frame").value)] ?? 0];
  }

  // Builds what is drawn of the parts.
  show() {
    const { view } = this,
      names = () => view.panes.map(({ part }) => part.prefix).join(),
      before = names();
    this.quantity = this.facts.quantities[Number(get("quantity").value)];
    view.panes.forEach(({ surface }) => view.release(surface));
    this.gaps = false;
    view.panes = this.wanted().map((number) => this.pane(number ? new Part(this.facts, number) : this.first));
    if (before !== names()) {
      this.picked = null;
      get("reading").replaceChildren(this.hint);
    }
    get("time").textContent = `${short(view.panes[0].part.time)} s`;
    this.settle();
  }

  pane(part) {
    const position = part.cornersOf(part.positions),
      normal = cornerNormals(position, part.nodes, this.view.planes),
      value = part.values(this.quantity).map((x) => (Number.isFinite(x) ? x : NONE)),
      wall = part.values(this.facts.quantities[0]);
    this.gaps ||= ["contact_time", TOOL].includes(this.quantity.key) && value.includes(NONE);
    return { part, surface: this.view.surface({ position, normal, value, wall }, 3 * part.count) };
  }

  buildMold() {
    const { facts, view } = this;
    const built = (name, { mirrored }) => {
      const [nodes, places] = [facts.array(`${name}.triangles`), facts.array(`${name}.positions`)],
        position = new Float32Array(3 * nodes.length);
      for (let k = 0; k < position.length; k++) position[k] = places[3 * nodes[(k / 3) | 0] + (k % 3)];
      return { surface: view.surface({ position }, nodes.length), mirrored };
    };
    if (facts.mold) view.mold = built("mold", facts.mold);
    view.tools = facts.tools.map((tool, number) => built(`tool${number}`, tool));
  }

  // Takes over what is chosen without a new part.
  settle() {
    const { view, quantity } = this,
      limit = parseFloat(get("limit").value),
      [whole, mold, edges] = ["whole", "mold", "edges"].map((id) => get(id).checked);
    view.options = { whole, mold, edges, range: [quantity.low, quantity.high], limit: limit > 0 ? limit : -1 };
    const share = limit > 0 ? view.panes[view.panes.length - 1].part.shareBelow(limit / MM) : NaN;
    get("below").textContent = limit > 0 ? `${short(100 * share, 3)} % of the area` : "";
    // The end's box for all frames, so that nothing jumps.
    view.frame([this.first.positions, view.panes[0].part.positions]);
    this.colorBar();
    this.redraw();
  }

  colorBar() {
    const value = this.picked ? valueAt(this.picked.reading, this.quantity) : NaN;
    colorBar(this.quantity, this.facts, value, this.gaps);
  }

  redraw() {
    this.waiting ??= requestAnimationFrame(() => {
      this.waiting = null;
      this.view.draw();
      const { panes } = this.view;
      this.overlay.draw(this.picked?.marks ?? [], panes[panes.length - 1].part === this.first);
      clearTimeout(this.resting);
      this.resting = setTimeout(() => this.overlay.hideBehind(), 120);
    });
  }

  // Tells what is at a place that was picked.
  read({ pane, element: number, shares, image }) {
    const { panes } = this.view,
      reading = pane.part.at(number, shares),
      other = panes.find((one) => one !== pane);
    this.picked = {
      reading,
      part: pane.part,
      marks: [{ pane: panes.indexOf(pane), point: inImage(image, reading.formed) }],
    };
    if (other) {
      // The same place of the sheet in the part beside it.
      const place = other.part.nearest(reading.initial, other.part.reference),
        { formed, thickness } = other.part.at(place.element, place.shares);
      this.picked.beside = { label: other.part.label, thickness };
      this.picked.marks.push({ pane: panes.indexOf(other), point: inImage(image, formed) });
    }
    this.tell();
    this.colorBar();
    this.redraw();
  }

  tell() {
    const box = get("reading"),
      { thickness, element: number, formed } = this.picked.reading;
    box.replaceChildren();
    const list = element(box, "dl");
    for (const [name, value] of wordsOf(this.picked)) {
      const row = element(list, "div");
      element(row, "dt", {}, name);
      element(row, "dd", {}, value);
    }
    Object.assign(box.dataset, { thickness, element: number, place: formed.join() });
  }

  // Shows the place of a point of a diagram.
  follow({ places, part }, number) {
    if (!this.view) return;
    const formed = [...this.facts.array(places).subarray(3 * number, 3 * number + 3)];
    this.visit({ formed, part });
  }

  // Turns the view to a place of the best design, or of another part, and reads it.
  visit({ formed, part = 0 }) {
    if (formed.includes(null)) return;
    const wanted = ["best", "start"][part],
      { view } = this;
    if (!["both", wanted].includes(get("shown").value)) get("shown").value = wanted;
    if (this.frames.length) get("frame").value = this.frames.length;
    this.show();
    const pane = view.panes.find((one) => one.part.prefix === `part${part}`),
      away = formed.map((x, k) => x - view.center[k]);
    view.azimuth = Math.atan2(away[1], away[0]);
    view.elevation = clamp(Math.atan2(view.up * away[2], Math.hypot(away[0], away[1])), -1.2, 1.2);
    this.read({ pane, ...pane.part.nearest(formed), image: view.images(false)[0] });
    const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
    get("stage").scrollIntoView({ behavior: calm ? "auto" : "smooth", block: "start" });
  }
}

function theme() {
  const style = getComputedStyle(document.documentElement),
    color = (name) => rgb(style.getPropertyValue(name).trim().slice(1));
  return { stage: color("--stage"), line: color("--box"), mold: color("--mold"), tool: color("--tool") };
}

function complain(words) {
  const problem = get("problem");
  problem.hidden = false;
  problem.textContent =
    `The part cannot be drawn here (${words}). It needs a browser with WebGL2 and DecompressionStream: any ` +
    "since 2023. The tables on this page are complete.";
  for (const part of [get("bar"), ...document.querySelectorAll("#stage .tools, #reading")]) part.hidden = true;
  document.documentElement.dataset.ready = "no";
}

start().catch((error) => complain(error.message));
