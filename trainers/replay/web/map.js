// Draws the map of a panel at a step on a canvas.

import { burns } from "./knowledge.js";
import { uavStyle } from "./palette.js";

const TRAIL = 80; // steps
const MANY = 16; // UAVs above which links are thin and targets have no lines
const FLIGHT = [5, 5]; // dashes of links over which messages are on their way
const ROLE_COLOURS = ["--discoverer", "--seeker", "--wanderer"];
const SHAPES = [ // of the roles: corners right and down of the middle
  [[0, -1.75], [1.75, 0], [0, 1.75], [-1.75, 0]],
  [[0, -1.9], [1.8, 1.25], [-1.8, 1.25]],
  [[-1.35, -1.35], [1.35, -1.35], [1.35, 1.35], [-1.35, 1.35]],
];

/** Draws one panel: cells in colours, then lines and marks. */
export class MapView {
  constructor(canvas, data, panel, knowledge, seen) {
    Object.assign(this, { canvas, data, panel, knowledge, seen });
    this.cells = document.createElement("canvas");
    [this.cells.width, this.cells.height] = [data.columns, data.rows];
    this.oldest = Math.min(data.horizon, 300);
  }

  /** Draws a step; `options` are the layers, the chosen UAV and the palette. */
  draw(step, options) {
    const { canvas, data } = this;
    const width = canvas.clientWidth;
    const dots = window.devicePixelRatio || 1;
    const height = (width * data.rows) / data.columns;
    const size = [Math.round(width * dots), Math.round(height * dots)];
    if (canvas.width !== size[0] || canvas.height !== size[1]) {
      [canvas.width, canvas.height] = size;
    }
    this.scale = width / data.columns;
    this.half = Math.min(9.5, Math.max(7.5, 0.55 * this.scale)); // there is room for a number
    this.step = step;
    this.options = options;
    const pen = canvas.getContext("2d");
    pen.setTransform(size[0] / width, 0, 0, size[1] / height, 0, 0);
    this.pen = pen;
    this.drawCells(width, height);
    if (options.outline && (options.view !== "truth" || options.heat)) this.drawOutline();
    if (options.trails) this.drawTrails();
    if (options.views) this.drawViews();
    if (options.links) this.drawLinks();
    if (options.roles) this.drawTargets();
    this.drawBase();
    this.drawUavs();
  }

  point(x, y) {
    return [(x + 0.5) * this.scale, (this.data.rows - 0.5 - y) * this.scale];
  }

  /** Returns the x, y and z of a UAV in cells. */
  place(uav, step = this.step) {
    return [0, 1, 2].map((axis) => this.panel.position(step, uav * 3 + axis) / 100);
  }

  /** Returns the place of a radio on the canvas; the base is the last radio. */
  radio(number) {
    const [x, y] = number < this.panel.uavs ? this.place(number) : this.panel.base;
    return this.point(x, y);
  }

  flies(uav) {
    return this.step < this.panel.fails[uav];
  }

  drawCells(width, height) {
    const { rows, columns } = this.data;
    const pen = this.cells.getContext("2d");
    const image = pen.createImageData(columns, rows);
    const colour = this.cellColour();
    for (let x = 0; x < columns; x++) {
      for (let y = 0; y < rows; y++) {
        const [red, green, blue] = colour(x * rows + y);
        image.data.set([red, green, blue, 255], ((rows - 1 - y) * columns + x) * 4);
      }
    }
    pen.putImageData(image, 0, 0);
    this.pen.imageSmoothingEnabled = false;
    this.pen.drawImage(this.cells, 0, 0, width, height);
  }

  /** Returns a function that gives the red, green and blue of a cell. */
  cellColour() {
    const { palette, view, heat, uav } = this.options;
    const { knowledge, panel, step, data } = this;
    const names = ["ground", "unknown", "fire", "unseen", "burnt", "missed"];
    const [ground, unknown, fire, unseen, burnt, missed] = names.map((n) => palette.bytes(`--${n}`));
    const radio = { uav, base: panel.uavs }[view] ?? panel.radios;
    const last = knowledge.last[radio];
    if (heat) {
      return (cell) => {
        const lit = burns(data, cell, step);
        if (last[cell] < 0 && !(lit && radio === panel.radios)) return unknown;
        return this.warm(step - Math.max(last[cell], lit ? data.ignition[cell] : 0), palette.heat);
      };
    }
    if (view === "truth" || view === "team") {
      const known = view === "team" ? this.seen : null;
      return (cell) => {
        if (data.ignition[cell] > step) return known && last[cell] < 0 ? unknown : ground;
        const found = !known || known[cell] <= step;
        if (data.end[cell] <= step) return found ? burnt : missed;
        return found ? fire : unseen;
      };
    }
    return (cell) => { // what burned at the last look
      if (last[cell] < 0) return unknown;
      if (last[cell] < data.ignition[cell]) return ground;
      return last[cell] < data.end[cell] ? fire : burnt;
    };
  }

  /** Returns the colour of an age. */
  warm(age, stops) {
    const place = Math.sqrt(Math.min(1, age / this.oldest)) * (stops.length - 1);
    const below = Math.min(stops.length - 2, Math.floor(place));
    return stops[below].map((value, at) => value + (stops[below + 1][at] - value) * (place - below));
  }

  /** Draws the edge between cells that burn and others. */
  drawOutline() {
    const { rows, columns } = this.data;
    const lit = (x, y) => x >= 0 && y >= 0 && x < columns && y < rows
      && burns(this.data, x * rows + y, this.step);
    const edges = new Path2D();
    const edge = (x, y, toX, toY) => {
      edges.moveTo(...this.point(x - 0.5, y - 0.5));
      edges.lineTo(...this.point(toX - 0.5, toY - 0.5));
    };
    for (let x = 0; x <= columns; x++) {
      for (let y = 0; y <= rows; y++) {
        if (lit(x, y) !== lit(x - 1, y)) edge(x, y, x, y + 1);
        if (lit(x, y) !== lit(x, y - 1)) edge(x, y, x + 1, y);
      }
    }
    this.line("--outline", 1.5);
    this.pen.stroke(edges);
  }

  line(colour, width, dashes = []) {
    this.pen.strokeStyle = colour.startsWith("--") ? this.options.palette.named(colour) : colour;
    this.pen.lineWidth = width;
    this.pen.setLineDash(dashes);
    this.pen.lineDashOffset = 0;
  }

  drawTrails() {
    const { pen, panel } = this;
    for (let uav = 0; uav < panel.uavs; uav++) {
      const { stroke, dash } = uavStyle(this.options.palette, uav);
      this.line(stroke, uav === this.options.uav ? 3.5 : 2.25, dash);
      for (let step = Math.max(1, this.step - TRAIL + 1); step <= this.step; step++) {
        pen.globalAlpha = 1 - (this.step - step) / TRAIL;
        const [from, to] = [step - 1, step].map((at) => this.point(...this.place(uav, at)));
        this.stroke(from, to);
        pen.lineDashOffset += Math.hypot(to[0] - from[0], to[1] - from[1]); // dashes go on
      }
    }
    pen.globalAlpha = 1;
  }

  stroke(from, to) {
    this.pen.beginPath();
    this.pen.moveTo(...from);
    this.pen.lineTo(...to);
    this.pen.stroke();
  }

  drawViews() {
    for (let uav = 0; uav < this.panel.uavs; uav++) {
      if (!this.flies(uav)) continue;
      const [x, y, z] = this.place(uav);
      const reach = z * this.panel.slope * this.scale;
      const [right, down] = this.point(x, y);
      for (const [colour, width] of [["--view-edge", 3.5], ["--view", 1.5]]) {
        this.line(colour, width);
        this.pen.strokeRect(right - reach, down - reach, 2 * reach, 2 * reach);
      }
    }
  }

  /** Returns the number of messages on their way to a radio from one other, or from all. */
  flying(taker, source = null) {
    const { radios, hears, delay = 0 } = this.panel;
    let count = 0;
    for (let step = Math.max(0, this.step - delay + 1); step <= this.step; step++) {
      for (let from = source ?? 0; from <= (source ?? radios - 1); from++) {
        count += hears(step, taker * radios + from);
      }
    }
    return count;
  }

  /** Draws half a line, up to the middle, at each radio that hears another one, or will. */
  drawLinks() {
    const { panel } = this;
    const many = panel.uavs > MANY;
    const sent = this.step - (panel.delay ?? 0);
    for (let taker = 0; taker < panel.radios; taker++) {
      for (let source = 0; source < panel.radios; source++) {
        const link = taker * panel.radios + source;
        const heard = sent >= 0 && panel.hears(sent, link);
        const comes = heard || (panel.delay && this.flying(taker, source));
        const lost = this.options.lost && panel.lost?.(this.step, link);
        if (!comes && !lost) continue;
        const [from, to] = [this.radio(taker), this.radio(source)];
        const middle = from.map((value, axis) => (value + to[axis]) / 2);
        if (!many && comes) {
          this.line("--view-edge", 4, heard ? [] : FLIGHT);
          this.stroke(from, middle);
        }
        if (comes) this.line("--link", many ? 1 : 2, heard ? [] : FLIGHT);
        else this.line("--lost", many ? 1 : 2, [3, 3]);
        this.stroke(from, middle);
        if (lost) this.cross(from.map((value, axis) => 0.45 * value + 0.55 * middle[axis]), 4, "--lost");
      }
    }
  }

  cross([right, down], half, colour, width = 2) {
    this.line(colour, width);
    this.stroke([right - half, down - half], [right + half, down + half]);
    this.stroke([right - half, down + half], [right + half, down - half]);
  }

  role(uav) {
    const followed = this.panel.follows?.(this.step, uav);
    if (followed === undefined) return null;
    return followed < 0 ? 2 : Number(followed !== uav);
  }

  drawTargets() {
    if (!this.panel.target) return;
    for (let uav = 0; uav < this.panel.uavs; uav++) {
      if (!this.flies(uav)) continue;
      const colour = ROLE_COLOURS[this.role(uav) ?? 2];
      const target = this.point(...[0, 1].map((axis) => this.panel.target(this.step, uav * 2 + axis) / 100));
      if (this.panel.uavs <= MANY || uav === this.options.uav) {
        this.line("--view-edge", 3, [4, 4]); // white on light ground needs an edge
        this.stroke(this.radio(uav), target);
        this.line(colour, 1.5, [4, 4]);
        this.stroke(this.radio(uav), target);
      }
      this.cross(target, 0.6 * this.half, "--view-edge", 4);
      this.cross(target, 0.6 * this.half, colour);
    }
  }

  drawBase() {
    if (!this.panel.base) return;
    const [right, down] = this.radio(this.panel.uavs);
    const { pen, half, options } = this;
    pen.fillStyle = options.palette.named("--base");
    pen.fillRect(right - half, down - half, 2 * half, 2 * half);
    this.line("--ring", 2);
    pen.strokeRect(right - half, down - half, 2 * half, 2 * half);
  }

  /** Writes the bytes that wait at a UAV beside it, within the map. */
  drawWaiting(uav) {
    const bytes = this.panel.waits?.(this.step, uav);
    if (!bytes || !this.flies(uav) || (this.panel.uavs > MANY && uav !== this.options.uav)) return;
    const { pen, half } = this;
    const [right, down] = this.radio(uav);
    pen.font = "600 11px system-ui, sans-serif";
    [pen.textAlign, pen.textBaseline] = ["left", "middle"];
    const width = pen.measureText(bytes).width + 6;
    const left = Math.min(right + half + 2, this.canvas.clientWidth - width);
    const middle = Math.max(down - half - 4, 7);
    pen.fillStyle = this.options.palette.named("--view-edge");
    pen.fillRect(left, middle - 7, width, 14);
    pen.fillStyle = this.options.palette.named("--view");
    pen.fillText(bytes, left + 3, middle + 0.5);
  }

  drawUavs() {
    const { uav: chosen } = this.options;
    const others = Array.from({ length: this.panel.uavs }, (_, uav) => uav).filter((uav) => uav !== chosen);
    if (this.options.links) for (const uav of [...others, chosen]) this.drawWaiting(uav);
    for (const uav of [...others, chosen]) { // the chosen one on top
      const place = this.radio(uav);
      if (this.flies(uav)) this.drawUav(uav, place);
      else if (this.options.failed) {
        this.cross(place, this.half, "--view-edge", 5);
        this.cross(place, this.half, "--failed", 3);
      }
    }
  }

  disc(right, down, radius, colour) {
    const { pen } = this;
    pen.beginPath();
    pen.arc(right, down, radius, 0, 2 * Math.PI);
    pen.fillStyle = colour;
    pen.fill();
    this.line("--view-edge", 1.5);
    pen.stroke();
  }

  drawUav(uav, [right, down]) {
    const { pen, half } = this;
    const { palette, roles } = this.options;
    const role = roles ? this.role(uav) : null;
    if (role !== null) {
      pen.beginPath();
      for (const [x, y] of SHAPES[role]) pen.lineTo(right + half * x, down + half * y);
      pen.closePath();
      pen.fillStyle = palette.named(ROLE_COLOURS[role]);
      pen.fill();
      this.line("--view-edge", 1.5);
      pen.stroke();
    }
    const { stroke, ink } = uavStyle(palette, uav);
    if (uav === this.options.uav) this.disc(right, down, half + 2.5, palette.named("--ring"));
    this.disc(right, down, half, stroke);
    pen.fillStyle = ink;
    pen.font = `700 ${Math.round(half * (uav < 10 ? 1.3 : 1.15))}px system-ui, sans-serif`;
    [pen.textAlign, pen.textBaseline] = ["center", "middle"];
    pen.fillText(String(uav), right, down + 0.5);
  }
}
