// The view: WebGL2 draws the part, its images, the mold and a box; each pixel can tell which element it shows.

class View {
  constructor(canvas, { symmetry, hangs }) {
    this.canvas = canvas;
    this.up = hangs ? -1 : 1;
    this.panes = [];
    this.tools = [];
    this.options = { whole: true, mold: true, edges: false, limit: -1, range: [0, 1] };
    this.planes = Object.entries(symmetry).map(([axis, level]) => ["xyz".indexOf(axis), level]);
    this.gl = canvas.getContext("webgl2", { antialias: true, alpha: false, preserveDrawingBuffer: true });
    if (!this.gl) throw new Error("no WebGL2");
    this.prepare();
    this.home();
  }

  prepare() {
    const { gl } = this,
      program = (this.program = gl.createProgram());
    for (const [kind, text] of [
      [gl.VERTEX_SHADER, VERTEX],
      [gl.FRAGMENT_SHADER, FRAGMENT],
    ]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    ["position", "normal", "value", "wall"].forEach((name, place) => gl.bindAttribLocation(program, place, name));
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS))
      throw new Error(gl.getProgramInfoLog(program) || "the shaders fail");
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
    const { gl } = this,
      buffers = ["position", "normal", "value", "wall"].map((name) => {
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

  // Puts the box around places (and their images) in the middle of the view.
  frame(all) {
    const low = [Infinity, Infinity, Infinity],
      high = [-Infinity, -Infinity, -Infinity];
    for (const { flip, shift } of this.images(this.options.whole))
      for (const places of all)
        for (let k = 0; k < places.length; k++) {
          const axis = k % 3,
            value = flip[axis] * places[k] + shift[axis];
          if (value < low[axis]) low[axis] = value;
          if (value > high[axis]) high[axis] = value;
        }
    if (this.box?.join() === [low, high].join()) return;
    this.box = [low, high];
    this.radius = 0.5 * Math.hypot(...high.map((value, axis) => value - low[axis])) || 1;
    this.center = high.map((value, axis) => 0.5 * (value + low[axis]));
    this.edges = boxEdges(low, high);
    this.fits = {};
    this.release(this.lines);
    this.lines = this.surface({ position: new Float32Array(this.edges.flat(2)) }, 2 * this.edges.length);
  }

  home() {
    Object.assign(this, {
      azimuth: -Math.PI / 4,
      elevation: this.up < 0 ? 0.62 : 0.42,
      zoom: 1,
      pan: [0, 0],
      fits: {},
    });
  }

  axes() {
    const { up, azimuth, elevation } = this,
      cos = Math.cos(elevation);
    const forward = [-cos * Math.cos(azimuth), -cos * Math.sin(azimuth), -up * Math.sin(elevation)];
    const right = unitVector([-up * Math.sin(azimuth), up * Math.cos(azimuth), 0]);
    return { forward, right, above: cross(right, forward) };
  }

  // How far the eye must be for the box to be in the picture, seen as it is now; kept while the view is turned.
  fit(aspect) {
    if (this.fits[aspect]) return this.fits[aspect];
    const { forward, right, above } = this.axes(),
      slope = 0.92 * Math.tan(FIELD / 2);
    const corners = [0, 1, 2, 3, 4, 5, 6, 7].map((k) =>
      this.center.map((x, axis) => this.box[(k >> axis) & 1][axis] - x),
    );
    const needed = corners.map(
      (at) => Math.max(Math.abs(dot(at, right)) / aspect, Math.abs(dot(at, above))) / slope - dot(at, forward),
    );
    return (this.fits[aspect] = Math.max(...needed, 0.1 * this.radius));
  }

  camera(aspect) {
    const { radius } = this,
      { forward, right, above } = this.axes(),
      away = forward.map((x) => -x);
    const distance = this.fit(aspect) / this.zoom;
    const target = this.center.map((x, k) => x - (this.pan[0] * right[k] + this.pan[1] * above[k]) * radius);
    const eye = target.map((x, k) => x + distance * away[k]);
    const near = Math.max(distance - 3 * radius, 0.01 * radius),
      far = distance + 3 * radius,
      f = 1 / Math.tan(FIELD / 2);
    const rows = [
      [...right.map((x) => (x * f) / aspect), (-dot(right, eye) * f) / aspect],
      [...above.map((x) => x * f), -dot(above, eye) * f],
      [
        ...forward.map((x) => (x * (far + near)) / (far - near)),
        (-dot(forward, eye) * (far + near) - 2 * far * near) / (far - near),
      ],
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
    const { canvas, panes } = this,
      width = canvas.clientWidth / Math.max(panes.length, 1),
      height = canvas.clientHeight;
    panes.forEach(
      (pane, k) => (pane.seen = { left: k * width, width, height, camera: this.camera(width / Math.max(height, 1)) }),
    );
  }

  draw() {
    const { gl, canvas } = this,
      ratio = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((size) =>
      Math.max(Math.round(size * ratio), 1),
    );
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
    gl.uniformMatrix4fv(
      at.camera,
      false,
      [0, 1, 2, 3].flatMap((k) => camera.rows.map((row) => row[k])),
    );
    gl.uniform3fv(at.eye, camera.eye);
    gl.uniform3fv(
      at.light,
      unitVector(camera.forward.map((x, k) => -x + 0.45 * camera.above[k] + 0.25 * camera.right[k])),
    );
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
    gl.uniform3fv(
      at.paint,
      this.theme.line.map((x) => x / 255),
    );
    this.drawImages(this.lines, false, gl.LINES);
    if (options.mold && (this.mold || this.tools.length)) {
      gl.uniform1i(at.mode, MODE.mold);
      gl.enable(gl.BLEND);
      gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
      gl.depthMask(false);
      // Where the part lies on it, the part is seen.
      gl.enable(gl.POLYGON_OFFSET_FILL);
      gl.polygonOffset(2, 40);
      const shown = [[this.mold, this.theme.mold, pane.part.mold]];
      this.tools.forEach((tool, k) => shown.push([tool, this.theme.tool, pane.part.tools[k]]));
      for (const [tool, paint, moved] of shown) {
        if (!tool) continue;
        gl.uniform3fv(
          at.paint,
          paint.map((x) => x / 255),
        );
        this.drawImages(tool.surface, options.whole && tool.mirrored, gl.TRIANGLES, moved);
      }
      gl.disable(gl.POLYGON_OFFSET_FILL);
      gl.depthMask(true);
      gl.disable(gl.BLEND);
    }
  }

  // The surface and its images, all moved first.
  drawImages(surface, wanted, kind = this.gl.TRIANGLES, moved = [0, 0, 0]) {
    const { gl, at } = this;
    if (!surface) return;
    this.bind(surface);
    this.images(wanted).forEach(({ flip, shift }, number) => {
      gl.uniform3fv(at.flip, flip);
      gl.uniform3fv(
        at.shift,
        shift.map((x, axis) => x + flip[axis] * moved[axis]),
      );
      gl.uniform1i(at.image, number);
      gl.drawArrays(kind, 0, surface.count);
    });
  }

  // The element that is seen at a place in CSS pixels: its pane, number, image, and the shares of its corners.
  pick(x, y) {
    this.layout();
    const pane = this.panes.find(({ seen }) => x >= seen.left && x < seen.left + seen.width);
    if (!pane || y < 0 || y >= this.canvas.clientHeight) return null;
    const { gl, numbers } = this,
      { left, width, height } = pane.seen,
      ratio = this.canvas.height / height;
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
    const element = (code[0] | (code[1] << 8) | (code[2] << 16)) - 1,
      image = this.images(this.options.whole)[code[3] - 1];
    return { pane, element, image, shares: this.shares(pane, element, image, x, y) };
  }

  resizeNumbers(size) {
    const { gl, numbers } = this;
    if (numbers.size?.join() === size.join()) return;
    numbers.size = size;
    gl.bindFramebuffer(gl.FRAMEBUFFER, numbers.frame);
    for (const [buffer, format, place] of [
      [numbers.color, gl.RGBA8, gl.COLOR_ATTACHMENT0],
      [numbers.depth, gl.DEPTH_COMPONENT24, gl.DEPTH_ATTACHMENT],
    ]) {
      gl.bindRenderbuffer(gl.RENDERBUFFER, buffer);
      gl.renderbufferStorage(gl.RENDERBUFFER, format, ...size);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, place, gl.RENDERBUFFER, buffer);
    }
  }

  // Where the ray through a place in CSS pixels meets the plane of an element: shares of its corners, none below 0.
  shares(pane, element, image, x, y) {
    const { camera, left, width, height } = pane.seen,
      slope = Math.tan(FIELD / 2);
    const across = ((2 * (x - left)) / width - 1) * slope * camera.aspect,
      up = (1 - (2 * y) / height) * slope;
    const ray = camera.forward.map((value, k) => value + across * camera.right[k] + up * camera.above[k]);
    const corners = [0, 1, 2].map((k) => inImage(image, pane.part.corner(pane.part.positions, element, k))),
      [from, u, v] = [camera.eye, corners[1], corners[2]].map((end) => end.map((value, k) => value - corners[0][k])),
      normal = cross(u, v),
      fall = dot(normal, ray);
    if (!fall) return MIDDLE;
    return sharesOf(
      camera.eye.map((value, k) => value - (dot(normal, from) / fall) * ray[k]),
      corners,
    );
  }
}

// The twelve edges of a box, by their ends.
function boxEdges(low, high) {
  const ends = [low, high],
    found = [];
  for (let axis = 0; axis < 3; axis++)
    for (let k = 0; k < 4; k++) {
      const [one, other] = [0, 1, 2].filter((other) => other !== axis),
        corner = [0, 0, 0];
      corner[one] = ends[k & 1][one];
      corner[other] = ends[k >> 1][other];
      found.push(ends.map((end) => corner.map((value, place) => (place === axis ? end[axis] : value))));
    }
  return found;
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
