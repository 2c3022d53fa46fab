// Computes what the team, each UAV and the base know at a step, with the environment's rules:
// envs/world/knowledge.py (who knows what) and envs/world/coverage_map.py (what was seen).

const NEVER = -1;
const MEMORY = 2 ** 26; // bytes of all stored steps of a panel

/** Calls a function with the index of each cell that a UAV recognises at a step. */
function eachInView(panel, rows, step, uav, visit) {
  const [left, right, low, high] = [0, 1, 2, 3].map((side) => panel.view(step, uav * 4 + side));
  for (let x = left; x <= right; x++) {
    for (let y = low; y <= high; y++) {
      const place = (uav * panel.side + x - left) * panel.side + y - low;
      if (!panel.missed?.(step, place)) visit(x * rows + y);
    }
  }
}

/** Returns the first step at which any UAV saw each cell while it burned; horizon + 1 for never. */
export function firstSeen(data, panel) {
  const first = new Uint32Array(data.ignition.length).fill(panel.horizon + 1);
  for (let step = 1; step <= panel.horizon; step++) {
    for (let uav = 0; uav < panel.uavs; uav++) {
      eachInView(panel, data.rows, step, uav, (cell) => {
        if (step < first[cell] && burns(data, cell, step)) first[cell] = step;
      });
    }
  }
  return first;
}

/** Returns whether a cell burns at a step. */
export function burns(data, cell, step) {
  return data.ignition[cell] <= step && step < data.end[cell];
}

/**
 * Stores for each radio the last step at which each cell was seen, by it or by those whose messages
 * arrived, and whether it knows of a sighting of the cell while it burned. A message holds all that
 * its radio knows. The last map is that of the team: what any UAV has seen.
 */
export class Knowledge {
  constructor(data, panel) {
    this.data = data;
    this.panel = panel;
    const cells = data.ignition.length;
    const maps = panel.radios + 1;
    this.last = Array.from({ length: maps }, () => new Int32Array(cells).fill(NEVER));
    this.fire = Array.from({ length: maps }, () => new Uint8Array(cells));
    this.news = [new Int32Array(panel.radios * panel.uavs)];
    this.step = 0;
    const stored = Math.min(40, Math.max(2, Math.floor(MEMORY / (maps * cells * 5))));
    this.interval = Math.max(25, Math.ceil(panel.horizon / stored));
    this.stored = new Map([[0, this.copy()]]);
  }

  copy() {
    return { last: this.last.map((map) => map.slice()), fire: this.fire.map((map) => map.slice()) };
  }

  /** Goes to a step, from the nearest earlier one that is stored. */
  seek(step) {
    let from = Math.floor(step / this.interval) * this.interval;
    while (!this.stored.has(from)) from -= this.interval;
    if (step < this.step || this.step < from) {
      const stored = this.stored.get(from);
      this.last.forEach((map, radio) => map.set(stored.last[radio]));
      this.fire.forEach((map, radio) => map.set(stored.fire[radio]));
      this.step = from;
    }
    while (this.step < step) {
      this.advance(this.step + 1);
      if (this.step % this.interval === 0 && !this.stored.has(this.step)) {
        this.stored.set(this.step, this.copy());
      }
    }
  }

  /** Adds the sightings and messages of a step. */
  advance(step) {
    const { panel } = this;
    const [before, now] = [this.newsAt(step - 1), this.newsAt(step)];
    for (let uav = 0; uav < panel.uavs; uav++) {
      for (let radio = 0; radio < panel.radios; radio++) {
        const source = radio * panel.uavs + uav;
        for (let at = before[source] + 1; at <= now[source]; at++) this.look(radio, at, uav);
      }
      this.look(panel.radios, step, uav); // the team
    }
    this.step = step;
  }

  /** Enters into a map what a UAV saw at a step. */
  look(map, step, uav) {
    const { panel, data } = this;
    eachInView(panel, data.rows, step, uav, (cell) => {
      if (step > this.last[map][cell]) this.last[map][cell] = step;
      if (burns(data, cell, step)) this.fire[map][cell] = 1;
    });
  }

  /** Returns the step up to which each radio (row) knows the sightings of each UAV (column). */
  newsAt(step) {
    const { delay = 0 } = this.panel;
    for (let at = this.news.length; at <= step; at++) {
      const news = this.said(at);
      if (at > delay) this.hear(news, at - delay);
      this.news.push(news);
    }
    return this.news[step];
  }

  /** Adds what the radios said at a step to the news of those that heard it. */
  hear(news, then) {
    const { radios, uavs } = this.panel;
    const said = this.said(then);
    for (let taker = 0; taker < radios; taker++) {
      for (const source of sources(this.panel, then, taker)) {
        for (let uav = 0; uav < uavs; uav++) {
          const place = taker * uavs + uav;
          news[place] = Math.max(news[place], said[source * uavs + uav]);
        }
      }
    }
  }

  /** Returns the same as the radios say it at a step, before they hear anything. */
  said(step) {
    const news = this.news[step - 1].slice();
    for (let uav = 0; uav < this.panel.uavs; uav++) news[uav * this.panel.uavs + uav] = step;
    return news;
  }

  /** Returns the number of cells of which a radio knows a sighting made while they burned. */
  known(radio) {
    return this.fire[radio].reduce((sum, fire) => sum + fire, 0);
  }
}

/**
 * Returns the radios whose messages of a step arrive at a radio. If messages are neither late nor
 * limited, they are passed on within the step.
 */
function sources(panel, step, taker) {
  const found = new Set([taker]);
  for (const radio of found) {
    for (let source = 0; source < panel.radios; source++) {
      if (panel.hears(step, radio * panel.radios + source)) found.add(source);
    }
    if (panel.delay !== undefined) break;
  }
  return found;
}
