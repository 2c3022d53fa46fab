// Chooses the colours and dashes of UAVs and panels.

const UAV_COLOURS = ["--uav-0", "--uav-1", "--uav-2", "--uav-3", "--uav-4", "--uav-5"];
const UAV_DASHES = [[], [9, 5], [2, 4], [12, 4, 2, 4]]; // of lines; with the colours 24 pairs
const HEAT = ["--heat-0", "--heat-1", "--heat-2", "--heat-3", "--heat-4"];
const MARKERS = ["solid", "dashed", "dotted", "double"]; // borders in the legends, for each kind of dashes
const PANEL_COLOURS = ["--panel-0", "--panel-1", "--panel-2", "--panel-3"];
const PANEL_DASHES = [[], [8, 4], [2, 3], [8, 3, 2, 3]];

/** Returns the colours of the page's style, which depend on light and dark. */
export function colours() {
  const style = getComputedStyle(document.documentElement);
  const named = (name) => style.getPropertyValue(name).trim();
  const bytes = (name) => [1, 3, 5].map((at) => parseInt(named(name).slice(at, at + 2), 16));
  return { named, bytes, heat: HEAT.map(bytes) };
}

/** Returns the colour and the dashes of a UAV's lines, and the colour of its number. */
export function uavStyle(palette, uav) {
  const name = UAV_COLOURS[uav % UAV_COLOURS.length];
  const [red, green, blue] = palette.bytes(name);
  const kind = Math.floor(uav / UAV_COLOURS.length) % UAV_DASHES.length;
  return {
    stroke: palette.named(name),
    dash: UAV_DASHES[kind],
    marker: MARKERS[kind],
    ink: 0.299 * red + 0.587 * green + 0.114 * blue > 140 ? "#000000" : "#ffffff",
  };
}

/** Returns the colour and the dashes of a panel's lines. */
export function panelStyle(palette, place) {
  const kind = (place + Math.floor(place / PANEL_COLOURS.length)) % PANEL_DASHES.length;
  return {
    stroke: palette.named(PANEL_COLOURS[place % PANEL_COLOURS.length]),
    dash: PANEL_DASHES[kind],
    marker: MARKERS[kind],
  };
}
