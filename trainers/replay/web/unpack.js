// Reads the data of the page, which replay/page.py wrote.

/** Returns the episodes that a text in base64 holds; throws an error if it is damaged. */
export async function unpack(text) {
  const packed = Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  const plain = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const data = await new Response(plain).json();
  const [columns, rows] = data.grid;
  return { ...data, columns, rows, panels: data.panels.map((panel) => unpackPanel(panel, data.horizon)) };
}

/** Returns a panel with functions (step, row) in place of its rows of numbers. */
function unpackPanel({ steps, ...panel }, horizon) {
  const unpacked = { ...panel, radios: panel.uavs + (panel.base ? 1 : 0), horizon };
  for (const [name, rows] of Object.entries(steps)) {
    // A row is of one number, such as x of UAV 0: a list, or a text of 0 and 1.
    unpacked[name] = (step, row = 0) => Number(rows[row][step]);
  }
  return unpacked;
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
