// The view: WebGL2 draws the part, its images, the mold and a box; each pixel can tell which element it shows.

const FIELD = (30 * Math.PI) / 180;
const VIRIDIS = ["440154", "481567", "482677", "453781", "404788", "39568c", "33638d", "2d708e", "287d8e", "238a8d", "1f968b", "20a387", "29af7f", "3cbb75", "55c667", "73d055", "95d840", "b8de29", "dce319", "fde725"];
const MODE = { color: 0, number: 1, mold: 2, line: 3 };

const VERTEX = `#version 300 es
in vec3 position; in vec3 normal; in float value; in float wall;
uniform mat4 camera; uniform vec3 flip; uniform vec3 shift;
out vec3 place; out vec3 facing; out vec3 share; out float shown; out float thick; flat out int element;
void main() {
  place = flip * position + shift;
  facing = flip * normal;
  element = gl_VertexID / 3;
  int corner = gl_VertexID - 3 * element;
  share = vec3(corner == 0, corner == 1, corner == 2);
  shown = value; thick = wall;
  gl_Position = camera * vec4(place, 1.0);
}`;

const FRAGMENT = `#version 300 es
precision highp float; precision highp int;
in vec3 place; in vec3 facing; in vec3 share; in float shown; in float thick; flat in int element;
uniform int mode; uniform int image; uniform vec3 eye; uniform vec3 light; uniform vec2 range; uniform float limit;
uniform float edges; uniform vec3 paint; uniform sampler2D colors;
out vec4 color;
void main() {
  if (mode == ${MODE.number}) {
    int code = element + 1;
    color = vec4(float(code & 255), float((code >> 8) & 255), float((code >> 16) & 255), float(image + 1)) / 255.0;
    return;
  }
  if (mode == ${MODE.line}) { color = vec4(paint, 1.0); return; }
  vec3 sight = normalize(eye - place);
  if (mode == ${MODE.mold}) {
    vec3 normal = normalize(cross(dFdx(place), dFdy(place)));
    color = vec4(paint, mix(0.42, 0.1, pow(abs(dot(normal, sight)), 0.6)));
    return;
  }
  float t = clamp((shown - range.x) / (range.y - range.x), 0.0, 1.0);
  vec3 tint = shown < -1e20 ? vec3(0.62, 0.64, 0.67) : texture(colors, vec2((t * 255.0 + 0.5) / 256.0, 0.5)).rgb;
  if (thick < limit) tint = vec3(0.94, 0.16, 0.2);
  float bright = 0.62 + 0.42 * abs(dot(normalize(facing), light));
  if (edges > 0.0) {
    vec3 near = share / fwidth(share);
    float line = 1.0 - smoothstep(0.4, 1.3, min(near.x, min(near.y, near.z)));
    tint = mix(tint, vec3(0.0), 0.55 * line * smoothstep(3.0, 8.0, 1.0 / max(fwidth(share.x), max(fwidth(share.y), fwidth(share.z)))));
  }
  color = vec4(tint * bright, 1.0);
}`;

function rgb(hex) {
  return [0, 2, 4].map((k) => parseInt(hex.slice(k, k + 2), 16));
}

function mapColors(count) {
  const found = new Uint8Array(4 * count), knots = VIRIDIS.map(rgb);
  for (let k = 0; k < count; k++) {
    const place = (k / (count - 1)) * (knots.length - 1), first = Math.min(Math.floor(place), knots.length - 2);
    for (let part = 0; part < 3; part++)
      found[4 * k + part] = Math.round(knots[first][part] + (place - first) * (knots[first + 1][part] - knots[first][part]));
    found[4 * k + 3] = 255;
  }
  return found;
}

class View {
  constructor(canvas, { symmetry, hangs }) {
    this.canvas = canvas;
    this.up = hangs ? -1 : 1;
    this.panes = [];
    this.options = { whole: true, mold: true, edges: false, limit: -1, range: [0, 1] };
    this.planes = Object.entries(symmetry).map(([axis, level]) => ["xyz".indexOf(axis), level]);
    this.gl = canvas.getContext("webgl2", { antialias: true, alpha: false });
    if (!this.gl) throw new Error("no WebGL2");
    this.prepare();
    this.home();
  }

  prepare() {
    const { gl } = this, program = (this.program = gl.createProgram());
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    ["position", "normal", "value", "wall"].forEach((name, place) => gl.bindAttribLocation(program, place, name));
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program) || "the shaders fail");
    gl.useProgram(program);
    this.at = new Proxy({}, { get: (known, name) => (known[name] ??= gl.getUniformLocation(program, name)) });
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, mapColors(256));
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    this.numbers = { frame: gl.createFramebuffer(), color: gl.createRenderbuffer(), depth: gl.createRenderbuffer() };
  }

  // Buffers of a surface, by attribute; those that are not given are constant.
  surface(arrays, count) {
    const { gl } = this, buffers = ["position", "normal", "value", "wall"].map((name) => {
      if (!arrays[name]) return null;
      const buffer = gl.createBuffer();
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ARRAY_BUFFER, arrays[name], gl.STATIC_DRAW);
      return buffer;
    });
    return { buffers, count };
  }

  release(surface) {
    surface?.buffers.forEach((buffer) => buffer && this.gl.deleteBuffer(buffer));
  }

  bind({ buffers }) {
    const { gl } = this;
    buffers.forEach((buffer, place) => {
      if (!buffer) return gl.disableVertexAttribArray(place);
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, place < 2 ? 3 : 1, gl.FLOAT, false, 0, 0);
    });
  }

  images(wanted) {
    const found = [{ flip: [1, 1, 1], shift: [0, 0, 0] }];
    for (const [axis, level] of wanted ? this.planes : [])
      for (const { flip, shift } of [...found]) {
        const image = { flip: [...flip], shift: [...shift] };
        image.flip[axis] = -1;
        image.shift[axis] = 2 * level;
        found.push(image);
      }
    return found;
  }

  // Puts a box (low, high) in the middle of the view.
  frame(low, high) {
    this.box = [low, high];
    this.radius = 0.5 * Math.hypot(...high.map((value, axis) => value - low[axis])) || 1;
    this.center = high.map((value, axis) => 0.5 * (value + low[axis]));
    this.fits = {};
  }

  home() {
    Object.assign(this, { azimuth: -Math.PI / 4, elevation: this.up < 0 ? 0.62 : 0.42, zoom: 1, pan: [0, 0], fits: {} });
  }

  axes() {
    const { up, azimuth, elevation } = this, cos = Math.cos(elevation);
    const forward = [-cos * Math.cos(azimuth), -cos * Math.sin(azimuth), -up * Math.sin(elevation)];
    const right = unitVector([-up * Math.sin(azimuth), up * Math.cos(azimuth), 0]);
    return { forward, right, above: cross(right, forward) };
  }

  // How far the eye must be for the box to be in the picture, seen as it is now; kept while the view is turned.
  fit(aspect) {
    if (this.fits[aspect]) return this.fits[aspect];
    const { forward, right, above } = this.axes(), slope = 0.92 * Math.tan(FIELD / 2);
    const corners = [0, 1, 2, 3, 4, 5, 6, 7].map((k) => this.center.map((x, axis) => this.box[(k >> axis) & 1][axis] - x));
    const needed = corners.map((at) => Math.max(Math.abs(dot(at, right)) / aspect, Math.abs(dot(at, above))) / slope - dot(at, forward));
    return (this.fits[aspect] = Math.max(...needed, 0.1 * this.radius));
  }

  camera(aspect) {
    const { radius } = this, { forward, right, above } = this.axes(), away = forward.map((x) => -x);
    const distance = this.fit(aspect) / this.zoom;
    const target = this.center.map((x, k) => x - (this.pan[0] * right[k] + this.pan[1] * above[k]) * radius);
    const eye = target.map((x, k) => x + distance * away[k]);
    const near = Math.max(distance - 3 * radius, 0.01 * radius), far = distance + 3 * radius, f = 1 / Math.tan(FIELD / 2);
    const rows = [
      [...right.map((x) => (x * f) / aspect), (-dot(right, eye) * f) / aspect],
      [...above.map((x) => x * f), -dot(above, eye) * f],
      [...forward.map((x) => (x * (far + near)) / (far - near)), (-dot(forward, eye) * (far + near) - 2 * far * near) / (far - near)],
      [...forward, -dot(forward, eye)],
    ];
    return { rows, eye, right, above, forward, aspect, distance };
  }

  // Where a point is in a pane, in CSS pixels of the canvas, and how far from the eye.
  project(point, pane) {
    const { camera, left, width, height } = pane.seen;
    const [x, y, , w] = camera.rows.map((row) => dot(row, point) + row[3]);
    return [left + (0.5 + (0.5 * x) / w) * width, (0.5 - (0.5 * y) / w) * height, w];
  }

  layout() {
    const { canvas, panes } = this, width = canvas.clientWidth / Math.max(panes.length, 1), height = canvas.clientHeight;
    panes.forEach((pane, k) => (pane.seen = { left: k * width, width, height, camera: this.camera(width / Math.max(height, 1)) }));
  }

  draw() {
    const { gl, canvas } = this, ratio = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((size) => Math.max(Math.round(size * ratio), 1));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    this.layout();
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.clearColor(...this.theme.stage.map((x) => x / 255), 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    for (const pane of this.panes) {
      gl.viewport(Math.round(pane.seen.left * ratio), 0, Math.round(pane.seen.width * ratio), height);
      this.drawPane(pane);
    }
  }

  look({ seen: { camera } }, mode) {
    const { gl, at } = this;
    gl.enable(gl.DEPTH_TEST);
    gl.uniformMatrix4fv(at.camera, false, [0, 1, 2, 3].flatMap((k) => camera.rows.map((row) => row[k])));
    gl.uniform3fv(at.eye, camera.eye);
    gl.uniform3fv(at.light, unitVector(camera.forward.map((x, k) => -x + 0.45 * camera.above[k] + 0.25 * camera.right[k])));
    gl.uniform1i(at.mode, mode);
  }

  drawPane(pane) {
    const { gl, at, options } = this;
    this.look(pane, MODE.color);
    gl.uniform2fv(at.range, options.range);
    gl.uniform1f(at.limit, options.limit);
    gl.uniform1f(at.edges, options.edges ? 1 : 0);
    this.drawImages(pane.surface, options.whole);
    gl.uniform1i(at.mode, MODE.line);
    gl.uniform3fv(at.paint, this.theme.line.map((x) => x / 255));
    this.drawImages(this.lines, false, gl.LINES);
    if (options.mold && this.mold) {
      gl.uniform1i(at.mode, MODE.mold);
      gl.uniform3fv(at.paint, this.theme.mold.map((x) => x / 255));
      gl.enable(gl.BLEND);
      gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
      gl.depthMask(false);
      // Where the part lies on it, the part is seen.
      gl.enable(gl.POLYGON_OFFSET_FILL);
      gl.polygonOffset(2, 40);
      this.drawImages(this.mold, options.whole && this.moldMirrored);
      gl.disable(gl.POLYGON_OFFSET_FILL);
      gl.depthMask(true);
      gl.disable(gl.BLEND);
    }
  }

  drawImages(surface, wanted, kind = this.gl.TRIANGLES) {
    const { gl, at } = this;
    if (!surface) return;
    this.bind(surface);
    this.images(wanted).forEach(({ flip, shift }, number) => {
      gl.uniform3fv(at.flip, flip);
      gl.uniform3fv(at.shift, shift);
      gl.uniform1i(at.image, number);
      gl.drawArrays(kind, 0, surface.count);
    });
  }

  // The element that is seen at a place in CSS pixels: its pane, number, image, and the shares of its corners.
  pick(x, y) {
    this.layout();
    const pane = this.panes.find(({ seen }) => x >= seen.left && x < seen.left + seen.width);
    if (!pane || y < 0 || y >= this.canvas.clientHeight) return null;
    const { gl, numbers } = this, { left, width, height } = pane.seen, ratio = this.canvas.height / height;
    const size = [Math.max(Math.round(width * ratio), 1), this.canvas.height];
    const pixel = [Math.min(Math.floor((x - left) * ratio), size[0] - 1), size[1] - 1 - Math.floor(y * ratio)];
    this.resizeNumbers(size);
    gl.bindFramebuffer(gl.FRAMEBUFFER, numbers.frame);
    gl.viewport(0, 0, ...size);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(...pixel, 1, 1);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    this.look(pane, MODE.number);
    this.drawImages(pane.surface, this.options.whole);
    gl.disable(gl.SCISSOR_TEST);
    const code = new Uint8Array(4);
    gl.readPixels(...pixel, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, code);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    if (!code[3]) return null;
    const element = (code[0] | (code[1] << 8) | (code[2] << 16)) - 1, image = this.images(this.options.whole)[code[3] - 1];
    return { pane, element, image, shares: this.shares(pane, element, image, x, y) };
  }

  resizeNumbers(size) {
    const { gl, numbers } = this;
    if (numbers.size?.join() === size.join()) return;
    numbers.size = size;
    gl.bindFramebuffer(gl.FRAMEBUFFER, numbers.frame);
    for (const [buffer, format, place] of [[numbers.color, gl.RGBA8, gl.COLOR_ATTACHMENT0], [numbers.depth, gl.DEPTH_COMPONENT24, gl.DEPTH_ATTACHMENT]]) {
      gl.bindRenderbuffer(gl.RENDERBUFFER, buffer);
      gl.renderbufferStorage(gl.RENDERBUFFER, format, ...size);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, place, gl.RENDERBUFFER, buffer);
    }
  }

  // Where the ray through a place in CSS pixels meets the plane of an element: shares of its corners, none below 0.
  shares(pane, element, { flip, shift }, x, y) {
    const { camera, left, width, height } = pane.seen, slope = Math.tan(FIELD / 2);
    const across = ((2 * (x - left)) / width - 1) * slope * camera.aspect, up = (1 - (2 * y) / height) * slope;
    const ray = camera.forward.map((value, k) => value + across * camera.right[k] + up * camera.above[k]);
    const [a, b, c] = [0, 1, 2].map((k) => pane.part.corner(pane.part.positions, element, k).map((value, axis) => flip[axis] * value + shift[axis]));
    const [u, v] = [b, c].map((end) => end.map((value, k) => value - a[k])), from = camera.eye.map((value, k) => value - a[k]);
    const normal = cross(u, v), fall = dot(normal, ray), size = dot(normal, normal);
    if (!fall || !size) return [1 / 3, 1 / 3, 1 / 3];
    const way = -dot(normal, from) / fall, hit = from.map((value, k) => value + way * ray[k]);
    const found = [0, dot(cross(hit, v), normal) / size, dot(cross(u, hit), normal) / size];
    found[0] = 1 - found[1] - found[2];
    const kept = found.map((share) => Math.max(share, 0)), sum = kept[0] + kept[1] + kept[2];
    return kept.map((share) => share / sum);
  }
}

function dot(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

function unitVector(a) {
  const size = Math.hypot(...a) || 1;
  return a.map((x) => x / size);
}
