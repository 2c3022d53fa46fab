// Plays the episodes of the page: controls, layers, keys and numbers.

import { fixed, ratio, unpack } from "./unpack.js";
import { firstSeen, Knowledge } from "./knowledge.js";
import { colours, panelStyle } from "./palette.js";
import { MapView } from "./map.js";
import { Curves } from "./curves.js";

const find = (name) => document.getElementById(name);
const ADDRESS = 350; // milliseconds between two changes of the address
const counted = (number, word) => `${number} ${word}${number === 1 ? "" : "s"}`;

/** What a panel says about a step: name, text before the number, number, digits, text after. */
function numbers(panel, step) {
  const rows = [
    ["coverage", "coverage", ratio(panel.seen(step), panel.burnt(step)), 1, " %"],
    ["seen", "seen", panel.seen(step), 0, " cells"],
    ["burnt", "of", panel.burnt(step), 0, " burnt"],
    ["burning", "burning now", panel.burning(step), 0, ""],
    ["front_age", "front age so far", panel.front_age(step), 2, " steps"],
  ];
  if (panel.base_seen) {
    const covered = ratio(panel.base_seen(step), panel.burnt(step));
    rows.push(
      ["base_coverage", "base coverage", covered, 1, " %"],
      ["base_seen", "known to the base", panel.base_seen(step), 0, " cells"],
      ["base_age", "base age so far", panel.base_age(step), 2, " steps"],
    );
  }
  return rows;
}

/** The numbers of the chosen UAV. */
function uavNumbers(panel, knowledge, map, step, uav) {
  const rows = [
    ["known", panel.delay === undefined ? "knows" : "knows at most", knowledge.known(uav), 0, " cells of fire"],
    ...["x", "y", "z"].map((name, axis) =>
      [name, name, panel.position(step, uav * 3 + axis) / 100, 2, ""]),
  ];
  if (panel.delay) rows.push(["flying", "in flight to it", map.flying(uav), 0, " messages"]);
  if (panel.waits) rows.push(["waits", "waiting", panel.waits(step, uav), 0, " bytes"]);
  return step ? [["reward", "reward", panel.reward(step, uav), 2, ""], ...rows] : rows;
}

/** Replaces a text and a list of numbers. */
function list(box, text, rows) {
  box.replaceChildren(text, ...rows.map(([name, label, value, digits, unit]) => {
    const entry = document.createElement("span");
    const number = document.createElement("b");
    number.dataset.number = name;
    number.textContent = fixed(value, digits);
    entry.append(`${label} `, number, unit);
    return entry;
  }));
}

class Player {
  constructor(data) {
    Object.assign(this, { data, step: 0, playing: false, written: -Infinity });
    this.layers = [...document.querySelectorAll("#layers input")];
    this.panels = data.panels.map((panel, place) => this.makePanel(panel, place));
    this.curves = new Curves(find("curves"), data, (step) => this.seek(step));
    const most = Math.max(...data.panels.map((panel) => panel.uavs));
    find("uav").replaceChildren(...Array.from({ length: most }, (_, uav) => new Option(`UAV ${uav}`, uav)));
    const teams = [...new Set(data.panels.map((panel) => panel.uavs))].toSorted((a, b) => a - b);
    const uavs = [...teams.slice(0, -1), counted(most, "UAV")].join(" or ");
    find("about").textContent = `${data.columns} \u00d7 ${data.rows} cells, ${uavs}, ${counted(data.horizon, "step")}`;
    find("slider").max = data.horizon;
    find("last").textContent = data.horizon;
    const { oldest } = this.panels[0].map;
    find("oldest").textContent = oldest;
    find("middle").textContent = Math.round(oldest / 4); // colours follow the square root of the age
    this.offer();
    this.listen();
    this.restyle();
  }

  makePanel(panel, place) {
    const box = find("panel").content.firstElementChild.cloneNode(true);
    const part = (name) => box.querySelector(`.${name}`);
    part("title").textContent = panel.title;
    box.style.setProperty("--aspect", this.data.columns / this.data.rows);
    find("panels").append(box);
    const knowledge = new Knowledge(this.data, panel);
    const canvas = part("map");
    const map = new MapView(canvas, this.data, panel, knowledge, firstSeen(this.data, panel));
    canvas.addEventListener("click", (event) => this.choose(map, event));
    return { panel, place, box, part, knowledge, map, canvas };
  }

  /** Leaves out the layers that no panel has. */
  offer() {
    const { panels, horizon } = this.data;
    const burnsOut = this.data.end.some((step) => step <= horizon);
    const offered = {
      base: panels.some((panel) => panel.base),
      lost: panels.some((panel) => panel.lost),
      late: panels.some((panel) => panel.delay),
      packets: panels.some((panel) => panel.delay !== undefined),
      waits: panels.some((panel) => panel.waits),
      roles: panels.some((panel) => panel.follows),
      failed: panels.some((panel) => panel.fails.some((step) => step <= horizon)),
    };
    for (const [name, there] of Object.entries({ ...offered, burnt: burnsOut })) {
      const control = find(name)?.closest("label");
      const entries = document.querySelectorAll(`.of-${name}`);
      for (const part of [...entries, ...(control ? [control] : [])]) part.hidden = !there;
    }
  }

  listen() {
    const act = (name, action) => find(name).addEventListener("click", action);
    act("play", () => this.play(!this.playing));
    act("first", () => this.seek(0));
    act("back", () => this.seek(this.step - 1));
    act("forth", () => this.seek(this.step + 1));
    act("end", () => this.seek(this.data.horizon));
    find("slider").addEventListener("input", (event) => this.seek(Number(event.target.value)));
    find("layers").addEventListener("change", () => this.draw());
    find("uav").addEventListener("change", () => {
      this.curves.build(this.palette, this.uav);
      this.draw();
    });
    document.addEventListener("keydown", (event) => this.key(event));
    window.addEventListener("hashchange", () => this.seek(hashStep() ?? this.step));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.restyle());
    new ResizeObserver(() => this.draw()).observe(find("panels"));
  }

  get uav() {
    return Number(find("uav").value);
  }

  /** Handles the keys of the page, except where a control has its own use for them. */
  key(event) {
    const { target, key } = event;
    if (event.altKey || event.ctrlKey || event.metaKey || target.closest?.("select")) return;
    const slider = target.id === "slider";
    const choice = target.type === "radio";
    const pressed = target.closest?.("button, summary, input") && !slider;
    const jump = { Home: 0, End: this.data.horizon, ArrowLeft: this.step - 1, ArrowRight: this.step + 1 }[key];
    if (key === " " && !pressed && !event.shiftKey) {
      if (!event.repeat) this.play(!this.playing);
    } else if (jump !== undefined && !(choice && key.startsWith("Arrow"))) this.seek(jump);
    else return;
    event.preventDefault();
  }

  /** Chooses the UAV that was clicked on a map. */
  choose(map, event) {
    const far = Array.from({ length: map.panel.uavs }, (_, uav) => {
      const [right, down] = map.radio(uav);
      return Math.hypot(right - event.offsetX, down - event.offsetY);
    });
    const nearest = Math.min(...far);
    if (nearest > 20) return;
    find("uav").value = far.indexOf(nearest);
    find("uav").dispatchEvent(new Event("change"));
  }

  play(on) {
    if (on && this.step === this.data.horizon) this.go(0);
    this.playing = on;
    find("play").setAttribute("aria-label", on ? "Pause" : "Play");
    document.body.dataset.playing = on;
    if (!on) return this.settle();
    let [before, due] = [null, 0];
    const run = Symbol("run");
    this.run = run;
    const tick = (now) => {
      if (!this.playing || this.run !== run) return;
      due += ((now - (before ?? now)) / 1000) * Number(find("speed").value);
      before = now;
      const whole = Math.min(100, Math.floor(due)); // after a long wait it does not jump far
      due -= Math.floor(due);
      if (whole > 0) this.go(Math.min(this.data.horizon, this.step + whole));
      if (this.step === this.data.horizon) this.play(false);
      else requestAnimationFrame(tick);
    };
    return requestAnimationFrame(tick);
  }

  /** Stops at a step. */
  seek(step) {
    if (this.playing) this.play(false);
    this.go(Math.min(this.data.horizon, Math.max(0, step)));
    this.settle();
  }

  go(step) {
    this.step = step;
    this.draw();
  }

  /** Writes the step into the address and tells it to screen readers. */
  settle() {
    const covered = this.panels.map(({ panel }) =>
      `${panel.title}: coverage ${fixed(ratio(panel.seen(this.step), panel.burnt(this.step)), 1)} %`);
    find("said").textContent = `Step ${this.step}. ${covered.join(". ")}`;
    this.panels.forEach(({ canvas }, place) => {
      canvas.setAttribute("aria-label", `Map at step ${this.step}. ${covered[place]}`);
    });
    // Browsers limit how often the address changes. A frame without an address of its own, as in Jupyter, would
    // change that of its page.
    clearTimeout(this.later);
    if (location.protocol === "about:") return;
    const write = () => {
      this.written = performance.now();
      history.replaceState(null, "", `#t=${this.step}`);
    };
    const wait = this.written + ADDRESS - performance.now();
    if (wait > 0) this.later = setTimeout(write, wait);
    else write();
  }

  /** Reads the colours of the style again: light and dark differ. */
  restyle() {
    this.palette = colours();
    this.panels.forEach(({ place, part }) => {
      const { stroke, dash } = panelStyle(this.palette, place);
      part("swatch").setAttribute("stroke", stroke);
      part("swatch").setAttribute("stroke-dasharray", dash.join(" "));
    });
    this.curves.build(this.palette, this.uav);
    this.draw();
  }

  draw() {
    const { step, uav, palette } = this;
    const options = { palette, uav };
    const views = [];
    for (const layer of this.layers) {
      if (layer.type === "checkbox") options[layer.id] = layer.checked;
      else if (layer.checked) options.view = layer.value;
    }
    for (const { panel, part, knowledge, map } of this.panels) {
      knowledge.seek(step);
      const own = Math.min(uav, panel.uavs - 1);
      const view = options.view === "base" && !panel.base ? "team" : options.view;
      views.push(view);
      map.draw(step, { ...options, uav: own, view });
      list(part("of-team"), "", numbers(panel, step));
      const role = map.role(own);
      const told = role === null || !map.flies(own) ? "" : `, ${this.data.roles[role]}`;
      const who = `UAV ${own}${map.flies(own) ? "" : ", failed"}${told}:`;
      list(part("of-uav"), who, uavNumbers(panel, knowledge, map, step, own));
    }
    find("slider").value = step;
    find("slider").setAttribute("aria-valuetext", `step ${step} of ${this.data.horizon}`);
    find("step").textContent = step;
    const legend = views.includes("team") ? "team" : options.view; // its entries include those of "base"
    document.body.dataset.view = options.heat ? "heat" : legend;
    this.curves.show(step);
  }
}

function hashStep() {
  const step = /^#t=(\d{1,300})$/.exec(location.hash);
  return step ? Number(step[1]) : null;
}

function fail(text) {
  find("message").textContent = text;
  find("message").classList.remove("late");
  find("message").hidden = false;
  find("page").hidden = true;
}

async function start() {
  if (typeof DecompressionStream === "undefined") {
    return fail("This browser is too old for this page: it has no DecompressionStream.");
  }
  let data;
  try {
    data = await unpack(find("data").textContent.trim());
  } catch (error) {
    return fail(`The data of this page are damaged and cannot be shown (${error.message}).`);
  }
  find("message").hidden = true;
  find("page").hidden = false;
  try {
    return new Player(data).seek(hashStep() ?? 0);
  } catch (error) {
    fail(`This page is damaged and cannot be shown (${error.message}).`);
    throw error;
  }
}

start();
