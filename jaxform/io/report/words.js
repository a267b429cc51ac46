// What was picked, in words.

const MM = 1000;

// Names and values of what is at a place of a part; `beside` is the wall at the same place of the part beside it.
function wordsOf({ reading, part, beside }) {
  const [first, second] = reading.stretches,
    initial = reading.nodal("initial_thickness"),
    warm = reading.nodal("temperature");
  const places = (place) => `${place.map((x) => millimetres(x, 4)).join(", ")} mm`;
  const found = [
    ["wall", wallWords(reading.thickness)],
    ["stretches", `${short(first)} × ${short(second)}`],
    ["area stretch", short(first * second)],
    ["place in the part (x, y, z)", places(reading.formed)],
    ["initial place in the sheet", places(reading.initial)],
    ["contact", touchWords(reading.times)],
  ];
  const tools = part.facts.quantities.find(({ key }) => key === TOOL);
  if (tools) found.push(["tool in contact", tools.names[reading.tool] ?? "none"]);
  if (beside) found.unshift(["part", part.label]);
  if (Number.isFinite(initial)) found.push(["initial thickness", `${short(MM * initial)} mm`]);
  if (Number.isFinite(warm)) found.push(["temperature of the sheet", `${short(warm)} °C`]);
  if (beside) found.push([`wall there, ${beside.label}`, wallWords(beside.thickness)]);
  // Elements of a frame with a mesh of its own are in another order than in its file.
  const named = part.label !== "frame" || part.mesh === 0;
  return [
    ...found,
    named ? ["element in the file", `${reading.element}, level ${reading.level}`] : ["level", `${reading.level}`],
  ];
}

// A wall thickness [m] in mm; NaN of the sheet that is no part.
function wallWords(thickness) {
  return Number.isFinite(thickness) ? `${short(MM * thickness)} mm` : "not part of the product";
}

// What is shown of a quantity at a place, for the colour bar; NaN where there is nothing.
function valueAt(reading, { key, of, factor }) {
  if (key === AREA_STRETCH) return reading.stretches[0] * reading.stretches[1];
  if (key === "contact_time") return touched(reading.times);
  if (key === TOOL) return reading.tool;
  return factor * (of === "nodes" ? reading.nodal(key) : reading.own(key));
}

// A place [m] in mm; what is below a millionth of a mm is rounding.
function millimetres(value, digits) {
  return short(Math.round(1e9 * value) / 1e6 + 0, digits);
}

// When an element touched [s]: since its last corner; NaN where it does not, or was held from the start.
function touched(times) {
  const last = Math.max(...times);
  return last > 0 ? last : NaN;
}

function touchWords(times) {
  const known = times.filter((time) => Number.isFinite(time));
  if (known.length < 3) return known.length ? "some of its corners" : "none";
  return Math.max(...times) > 0 ? `at ${short(Math.max(...times))} s` : "from the start";
}
