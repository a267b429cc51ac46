// What the graphics card runs, and the map of colours.

const FIELD = (30 * Math.PI) / 180;
const VIRIDIS = [
  "440154",
  "481567",
  "482677",
  "453781",
  "404788",
  "39568c",
  "33638d",
  "2d708e",
  "287d8e",
  "238a8d",
  "1f968b",
  "20a387",
  "29af7f",
  "3cbb75",
  "55c667",
  "73d055",
  "95d840",
  "b8de29",
  "dce319",
  "fde725",
];
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
    // Of elements that are a few pixels large nothing else would be seen.
    vec3 change = fwidth(share);
    float tall = 1.0 / max(change.x, max(change.y, change.z));
    tint = mix(tint, vec3(0.0), 0.55 * line * smoothstep(3.0, 8.0, tall));
  }
  color = vec4(tint * bright, 1.0);
}`;

function rgb(hex) {
  return [0, 2, 4].map((k) => parseInt(hex.slice(k, k + 2), 16));
}

function gradient(end) {
  return `linear-gradient(to ${end}, ${VIRIDIS.map((hex) => `#${hex}`).join()})`;
}

function mapColors(count) {
  const found = new Uint8Array(4 * count),
    knots = VIRIDIS.map(rgb);
  for (let k = 0; k < count; k++) {
    const place = (k / (count - 1)) * (knots.length - 1),
      first = Math.min(Math.floor(place), knots.length - 2);
    for (let part = 0; part < 3; part++)
      found[4 * k + part] = Math.round(
        knots[first][part] + (place - first) * (knots[first + 1][part] - knots[first][part]),
      );
    found[4 * k + 3] = 255;
  }
  return found;
}
