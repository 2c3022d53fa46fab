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
 * arrived, and whether it knows of a sighting of the cell while it burned. The last map is that of
 * the team: what any UAV has seen.
 */
export class Knowledge {
  constructor(data, panel) {
    this.data = data;
    this.panel = panel;
    const cells = data.ignition.length;
    const maps = panel.radios + 1;
    this.last = Array.from({ length: maps }, () => new Int32Array(cells).fill(NEVER));
    this.fire = Array.from({ length: maps }, () => new Uint8Array(cells));
    this.reach = identity(panel.radios);
    this.step = 0;
    const stored = Math.min(40, Math.max(2, Math.floor(MEMORY / (maps * cells * 5))));
    this.interval = Math.max(25, Math.ceil(panel.horizon / stored));
    this.stored = new Map([[0, this.copy()]]);
  }

  copy() {
    return {
      last: this.last.map((map) => map.slice()),
      fire: this.fire.map((map) => map.slice()),
      reach: this.reach.slice(),
    };
  }

  /** Goes to a step, from the nearest earlier one that is stored. */
  seek(step) {
    let from = Math.floor(step / this.interval) * this.interval;
    while (!this.stored.has(from)) from -= this.interval;
    if (step < this.step || this.step < from) {
      const stored = this.stored.get(from);
      this.last.forEach((map, radio) => map.set(stored.last[radio]));
      this.fire.forEach((map, radio) => map.set(stored.fire[radio]));
      this.reach = stored.reach.slice();
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
    const { panel, data } = this;
    const reach = reachable(panel, step);
    const { radios } = panel;
    for (let uav = 0; uav < panel.uavs; uav++) {
      const takers = [radios]; // the team
      for (let radio = 0; radio < radios; radio++) {
        if (reach[radio * radios + uav]) takers.push(radio);
      }
      eachInView(panel, data.rows, step, uav, (cell) => {
        const burning = burns(data, cell, step);
        for (const taker of takers) {
          this.last[taker][cell] = step;
          if (burning) this.fire[taker][cell] = 1;
        }
      });
    }
    // Radios that stay in contact already know the same: only new contacts compare whole maps.
    for (let taker = 0; taker < radios; taker++) {
      for (let source = 0; source < radios; source++) {
        const link = taker * radios + source;
        if (reach[link] && !this.reach[link]) this.merge(taker, source);
      }
    }
    this.reach = reach;
    this.step = step;
  }

  /** Gives a radio all that another one knows. */
  merge(taker, source) {
    const [mine, other] = [this.last[taker], this.last[source]];
    const [myFire, otherFire] = [this.fire[taker], this.fire[source]];
    for (let cell = 0; cell < mine.length; cell++) {
      if (other[cell] > mine[cell]) mine[cell] = other[cell];
      myFire[cell] |= otherFire[cell];
    }
  }

  /** Returns the number of cells of which a radio knows a sighting made while they burned. */
  known(radio) {
    return this.fire[radio].reduce((sum, fire) => sum + fire, 0);
  }
}

function identity(size) {
  return Uint8Array.from({ length: size * size }, (_, at) => at % (size + 1) === 0);
}

/** Returns whose messages arrive at each radio, directly or passed on (a radio has a row). */
function reachable(panel, step) {
  const { radios } = panel;
  const reach = identity(radios);
  for (let radio = 0; radio < radios; radio++) {
    const waiting = [radio];
    while (waiting.length) {
      const taker = waiting.pop();
      for (let source = 0; source < radios; source++) {
        if (!reach[radio * radios + source] && panel.hears(step, taker * radios + source)) {
          reach[radio * radios + source] = 1;
          waiting.push(source);
        }
      }
    }
  }
  return reach;
}
