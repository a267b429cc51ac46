// A part as it is drawn: the corners of its elements, their normals and values, and what is at a place of an element.

const CREASE = Math.cos((35 * Math.PI) / 180);
const MIDDLE = [1 / 3, 1 / 3, 1 / 3]; // of an element, as shares of its corners
const AREA_STRETCH = "area_stretch";
const TOOL = "tool";

class Part {
  constructor(facts, number) {
    Object.assign(this, facts.parts[number]);
    this.facts = facts;
    this.prefix = `part${number}`;
    this.nodes = facts.array(`mesh${this.mesh}.triangles`);
    this.reference = facts.array(`mesh${this.mesh}.reference`);
    this.positions = facts.array(`${this.prefix}.positions`);
    this.count = this.nodes.length / 3;
  }

  // Values as they are packed, per element or node; of a frame also what it has in common with the end.
  raw(key) {
    if (key === "level") return this.facts.array(`mesh${this.mesh}.level`);
    const own = this.facts.array(`${this.prefix}.${key}`);
    if (own || this.mesh !== 0) return own;
    const last = this.facts.array(`part0.${key}`);
    if (key !== "contact_time" || !last) return last;
    return last.map((time) => (time <= this.time ? time : NaN));
  }

  // Values (3 count) at the corners of the elements, in the unit that is shown; NaN where there is none.
  values({ key, of, factor }) {
    const found = new Float32Array(3 * this.count).fill(NaN);
    if (key === AREA_STRETCH) {
      const [first, second] = [this.raw("stretch_1"), this.raw("stretch_2")];
      for (let k = 0; k < found.length; k++) found[k] = first[(k / 3) | 0] * second[(k / 3) | 0];
      return found;
    }
    const raw = key === TOOL ? this.touchedTools() : this.raw(key);
    if (!raw) return found;
    for (let k = 0; k < found.length; k++) found[k] = factor * (of === "nodes" ? raw[this.nodes[k]] : raw[(k / 3) | 0]);
    if (key === "contact_time") lastOfCorners(found);
    return found;
  }

  // The number of the tool that each element touches; NaN where it touches none.
  touchedTools() {
    const raw = this.facts.array(`${this.prefix}.${TOOL}`);
    return raw && raw.map(Math.round);
  }

  cornersOf(values) {
    const found = new Float32Array(9 * this.count);
    for (let k = 0; k < this.nodes.length; k++)
      for (let axis = 0; axis < 3; axis++) found[3 * k + axis] = values[3 * this.nodes[k] + axis];
    return found;
  }

  corner(values, element, corner) {
    const node = this.nodes[3 * element + corner];
    return [values[3 * node], values[3 * node + 1], values[3 * node + 2]];
  }

  // The share of the area where the wall is thinner than a limit [m].
  shareBelow(limit) {
    const walls = this.raw("thickness");
    let [below, all] = [0, 0];
    for (let k = 0; k < this.count; k++) {
      if (!Number.isFinite(walls[k])) continue; // of what is cut off the part
      const [a, b, c] = [0, 1, 2].map((corner) => this.corner(this.positions, k, corner));
      const [u, v] = [b, c].map((end) => end.map((x, axis) => x - a[axis]));
      const area = Math.hypot(...cross(u, v));
      all += area;
      if (walls[k] < limit) below += area;
    }
    return below / (all || 1);
  }

  // What is at a place of an element, given by the shares of its corners.
  at(element, shares) {
    const mixed = (values) =>
      [0, 1, 2].map((axis) => shares.reduce((sum, share, k) => sum + share * this.corner(values, element, k)[axis], 0));
    const nodes = [0, 1, 2].map((k) => this.nodes[3 * element + k]);
    const nodal = (key) => {
      const raw = this.raw(key);
      return raw ? shares.reduce((sum, share, k) => sum + share * raw[nodes[k]], 0) : NaN;
    };
    const own = (key) => this.raw(key)[element];
    const times = nodes.map((node) => (this.raw("contact_time") || [])[node] ?? NaN);
    return {
      element,
      times,
      nodal,
      own,
      formed: mixed(this.positions),
      initial: mixed(this.reference),
      thickness: own("thickness"),
      stretches: [own("stretch_1"), own("stretch_2")],
      level: own("level"),
      tool: (this.touchedTools() || [])[element] ?? NaN,
    };
  }

  // The element, and the shares of its corners, that are nearest to a place: of the part, or in the initial sheet.
  nearest(place, positions = this.positions) {
    const found = { element: 0, shares: MIDDLE };
    let best = Infinity;
    for (let element = 0; element < this.count; element++) {
      const corners = [0, 1, 2].map((k) => this.corner(positions, element, k)),
        reach = Math.hypot(...corners[0].map((x, axis) => x - place[axis]));
      // What is farther away than its own size and the best one cannot be nearer.
      if (reach - Math.max(span(corners[0], corners[1]), span(corners[0], corners[2])) > best) continue;
      const shares = sharesOf(place, corners),
        foot = place.map((_, axis) => shares.reduce((sum, share, k) => sum + share * corners[k][axis], 0)),
        away = span(foot, place);
      if (away >= best) continue;
      best = away;
      Object.assign(found, { element, shares });
    }
    return found;
  }
}

function span(a, b) {
  return Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);
}

// Shares of a triangle's corners at the foot of a place in its plane; none below 0.
function sharesOf(place, [a, b, c]) {
  const [u, v, from] = [b, c, place].map((end) => end.map((x, axis) => x - a[axis])),
    normal = cross(u, v),
    size = dot(normal, normal);
  if (!size) return MIDDLE;
  const [second, third] = [dot(cross(from, v), normal) / size, dot(cross(u, from), normal) / size];
  const kept = [1 - second - third, second, third].map((share) => Math.max(share, 0)),
    sum = kept[0] + kept[1] + kept[2];
  return kept.map((share) => share / sum);
}

// An element touches since its last corner does; clamped elements have no time of contact.
function lastOfCorners(values) {
  for (let k = 0; k < values.length; k += 3) {
    const last = Math.max(values[k], values[k + 1], values[k + 2]); // NaN where one is NaN
    values[k] = values[k + 1] = values[k + 2] = last > 0 ? last : NaN;
  }
}

// Normals (3 per corner): the mean of the elements around, but for those that bend away from it by more than a crease.
// On a symmetry plane the image's elements are around as well.
function cornerNormals(corners, nodes, planes) {
  const count = nodes.length / 3,
    own = new Float32Array(3 * count),
    mean = new Float32Array(3 * (1 + nodes.reduce((a, b) => Math.max(a, b), 0)));
  for (let k = 0; k < count; k++) {
    const p = corners.subarray(9 * k, 9 * k + 9);
    const [ux, uy, uz, vx, vy, vz] = [p[3] - p[0], p[4] - p[1], p[5] - p[2], p[6] - p[0], p[7] - p[1], p[8] - p[2]];
    const normal = [uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx],
      size = Math.hypot(...normal) || 1;
    for (let axis = 0; axis < 3; axis++) {
      own[3 * k + axis] = normal[axis] / size;
      for (let corner = 0; corner < 3; corner++) mean[3 * nodes[3 * k + corner] + axis] += normal[axis];
    }
  }
  const reach = corners.reduce((most, x) => Math.max(most, Math.abs(x)), 0);
  for (const [axis, level] of planes)
    for (let k = 0; k < 3 * count; k++)
      if (Math.abs(corners[3 * k + axis] - level) < 1e-5 * reach) mean[3 * nodes[k] + axis] = 0;
  const found = new Float32Array(9 * count);
  for (let k = 0; k < 3 * count; k++) {
    const [at, face] = [3 * nodes[k], 3 * ((k / 3) | 0)],
      size = Math.hypot(mean[at], mean[at + 1], mean[at + 2]) || 1;
    const along = (mean[at] * own[face] + mean[at + 1] * own[face + 1] + mean[at + 2] * own[face + 2]) / size;
    for (let axis = 0; axis < 3; axis++)
      found[3 * k + axis] = along > CREASE ? mean[at + axis] / size : own[face + axis];
  }
  return found;
}
