// Reads the data of the page, which replay/page.py wrote.

const TYPES = {
  u1: Uint8Array, i1: Int8Array, u2: Uint16Array, i2: Int16Array,
  u4: Uint32Array, i4: Int32Array, f4: Float32Array,
};
const VERSION = 1;
const BITS = ["hears", "lost", "missed"]; // a bit per step
const NEEDED = ["position", "view", "hears", "reward", "seen", "burning", "burnt"];

/** Returns the episodes that a text in base64 holds; throws an error if it is damaged. */
export async function unpack(text) {
  const buffer = await decompress(decoded(text));
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  if (header.version !== VERSION) throw new Error(`unknown version ${header.version}`);
  const [columns, rows] = header.grid;
  if (!header.panels.length) throw new Error("no episode");
  const read = (entry) => array(buffer, 4 + length, entry);
  return {
    ...header, columns, rows,
    ignition: read(header.ignition).values,
    end: read(header.end).values,
    panels: header.panels.map((panel) => unpackPanel(panel, read, header.horizon)),
  };
}

/** Returns the bytes of a text in base64. */
function decoded(text) {
  try {
    return Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  } catch {
    throw new Error("not in base64");
  }
}

/** Returns the content of bytes compressed with gzip. */
async function decompress(packed) {
  const plain = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  try {
    return await new Response(plain).arrayBuffer();
  } catch {
    throw new Error("not whole, or not compressed with gzip");
  }
}

/** Returns a panel with its arrays in place of their descriptions. */
function unpackPanel(panel, read, horizon) {
  const radios = panel.uavs + (panel.base ? 1 : 0);
  const unpacked = { ...panel, radios, horizon };
  for (const [name, entry] of Object.entries(panel)) {
    if (!entry?.type) continue;
    const { values, width } = read(entry);
    const steps = BITS.includes(name) ? width * 8 : width;
    if (steps < horizon + 1) throw new Error(`${name} has ${steps} steps of ${horizon + 1}`);
    if (BITS.includes(name)) {
      unpacked[name] = (step, taker, source) =>
        (values[(taker * radios + source) * width + (step >> 3)] >> (step & 7)) & 1;
    } else {
      // Row by row: what it is of, such as x of UAV 0, then the steps.
      unpacked[name] = (step, row = 0) => values[row * width + step];
    }
  }
  for (const name of NEEDED) {
    if (typeof unpacked[name] !== "function") throw new Error(`${name} is missing`);
  }
  return unpacked;
}

/** Returns the values of an array and the length of its last axis. */
function array(buffer, start, { type, shape, at, delta }) {
  const length = shape.reduce((product, side) => product * side, 1);
  const width = shape[shape.length - 1];
  const values = new TYPES[type](buffer, start + at, length);
  if (delta) {
    for (let index = 0; index < length; index++) {
      if (index % width) values[index] += values[index - 1];
    }
  }
  return { values, width };
}

/** Formats a number with digits after the point, halves to even, as Python does. */
export function fixed(value, digits) {
  const scaled = value * 10 ** digits;
  const below = Math.floor(scaled);
  const half = scaled - below === 0.5 && Math.abs(value) < 2 ** 31;
  const text = half ? ((below + (below % 2 !== 0)) / 10 ** digits).toFixed(digits)
    : value.toFixed(digits);
  return text.replace("-", "\u2212");
}

/** Returns seen / all cells in %, in float32 as the environment computes it. */
export function ratio(seen, all) {
  return all > 0 ? Math.fround(Math.fround(100 * seen) / all) : 100;
}
