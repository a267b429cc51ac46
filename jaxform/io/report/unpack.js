// Unpacks what packing.py packed.

async function unpack(text) {
  const letters = atob(text.trim()),
    packed = new Uint8Array(letters.length);
  for (let k = 0; k < letters.length; k++) packed[k] = letters.charCodeAt(k);
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  const size = new DataView(bytes.buffer).getUint32(0, true);
  const facts = JSON.parse(new TextDecoder().decode(bytes.subarray(4, 4 + size)));
  const content = bytes.subarray(4 + size),
    known = new Map();
  facts.array = (name) => {
    if (!known.has(name)) known.set(name, name in facts.arrays ? decode(content, facts.arrays[name]) : null);
    return known.get(name);
  };
  return facts;
}

function decode(content, { at, count, columns, coding, low, step }) {
  if (coding === "index") return decodeIndices(content.subarray(at), count);
  const values = new Float32Array(count * columns);
  for (let column = 0; column < columns; column++) {
    const high = content.subarray(at + 2 * count * column),
      rest = high.subarray(count);
    for (let k = 0, code = 0; k < count; k++) {
      const change = (high[k] << 8) | rest[k];
      code = (code + ((change >> 1) ^ -(change & 1))) & 65535;
      const value = code === 65535 ? NaN : low[column] + step[column] * code;
      values[k * columns + column] = coding === "relative" ? Math.exp(value) : value;
    }
  }
  return values;
}

function decodeIndices(content, count) {
  const corners = new Uint32Array(count);
  for (let k = 0, fresh = 0; k < count; k++) {
    corners[k] = fresh - ((content[k] << 16) | (content[count + k] << 8) | content[2 * count + k]);
    if (corners[k] === fresh) fresh++;
  }
  return corners;
}
