// Draws the measures against the step with uPlot; all charts share a cursor, which is the step.

import { fixed, ratio } from "./unpack.js";
import { panelStyle, uavStyle } from "./palette.js";

const MANY_UAVS = 8; // above this number, a chart of rewards shows the number of the chosen UAV only
const HEIGHT = 170;

/** The charts of a page: title, digits, and for each line its name and numbers by step. */
const MEASURES = [
  ["coverage", "Coverage, %", 1, (p, step) => ratio(p.seen(step), p.burnt(step))],
  ["front_age", "Front age: mean steps since burning cells were seen, up to the step", 2,
    (p, step) => p.front_age(step)],
  ["base_coverage", "Base coverage, %", 1,
    (p, step) => (p.base_seen ? ratio(p.base_seen(step), p.burnt(step)) : null)],
];

/** The charts below the maps. `seek` is called with a step that was clicked. */
export class Curves {
  constructor(parent, data, seek) {
    Object.assign(this, { parent, data, seek, hovered: false });
    this.steps = Float64Array.from({ length: data.horizon + 1 }, (_, step) => step);
    // A tap of a finger is no hovering: it would not end.
    parent.addEventListener("pointerenter", (event) => { this.hovered = event.pointerType === "mouse"; });
    parent.addEventListener("pointerleave", () => {
      this.hovered = false;
      this.show(this.step);
    });
    new ResizeObserver(() => this.resize()).observe(parent);
  }

  /** Draws all charts anew, in the colours of a palette. */
  build(palette, uav) {
    this.charts?.forEach((chart) => chart.destroy());
    const { panels } = this.data;
    const charts = MEASURES
      .filter(([name]) => name !== "base_coverage" || panels.some((panel) => panel.base_seen))
      .map(([name, title, digits, value]) => ({
        name, title, digits,
        lines: panels.map((panel, place) => ({
          label: panel.title,
          values: Array.from(this.steps, (step) => value(panel, step)),
          ...panelStyle(palette, place),
          width: 2,
        })),
      }));
    charts.push(...panels.map((panel, place) => this.rewards(palette, panel, place, uav)));
    // The width of a box depends on the number of boxes.
    const boxes = charts.map(({ name, title }) => this.box(name, title));
    this.parent.replaceChildren(...boxes);
    this.charts = charts.map((chart, place) => this.chart(palette, chart, boxes[place]));
    this.step ??= 0;
    queueMicrotask(() => this.show(this.step)); // uPlot sets its scales in a microtask, too
  }

  rewards(palette, panel, place, chosen) {
    const uav = Math.min(chosen, panel.uavs - 1); // panels may have teams of different sizes
    const lines = Array.from({ length: panel.uavs }, (_, number) => ({
      label: `UAV ${number}`,
      values: Array.from(this.steps, (step) => (step ? panel.reward(step, number) : null)),
      ...uavStyle(palette, number),
      width: number === uav ? 2.5 : 1,
      alpha: number === uav ? 1 : 0.55,
    }));
    lines.push(lines.splice(uav, 1)[0]); // the chosen one on top
    const many = panel.uavs > MANY_UAVS;
    return { name: `reward-${place}`, title: `Reward per UAV: ${panel.title}`, digits: 2, lines, many };
  }

  box(name, title) {
    const box = document.createElement("figure");
    const heading = document.createElement("figcaption");
    heading.textContent = title;
    box.append(heading);
    box.dataset.chart = name;
    return box;
  }

  chart(palette, { digits, lines, many }, box) {
    const axis = {
      stroke: palette.named("--ink"),
      grid: { stroke: palette.named("--grid"), width: 1 },
      ticks: { stroke: palette.named("--grid"), width: 1 },
    };
    const hidden = many ? lines.slice(0, -1) : [];
    const chart = new uPlot({
      width: box.clientWidth,
      height: HEIGHT,
      scales: { x: { time: false } },
      cursor: { sync: { key: "steps" }, drag: { x: false, y: false }, y: false, points: { show: false } },
      axes: [axis, { ...axis, size: 58 }],
      legend: { markers: { dash: (_chart, place) => lines[place - 1]?.marker ?? "solid" } },
      series: [{ label: "step" }, ...lines.map(({ label, stroke, dash, width, alpha }) => ({
        label, stroke, dash, width, alpha,
        points: { show: false },
        value: (_chart, number) => (number === null ? "\u2013" : fixed(number, digits)),
      }))],
    }, [this.steps, ...lines.map((line) => line.values)], box);
    const rows = box.querySelectorAll(".u-series");
    hidden.forEach((_, place) => { rows[place + 1].hidden = true; });
    chart.over.addEventListener("click", () => this.seek(chart.cursor.idx));
    return chart;
  }

  /** Puts the cursor of all charts on a step, unless the mouse is on one. */
  show(step) {
    this.step = step;
    if (this.hovered) return;
    for (const chart of this.charts ?? []) {
      chart.setCursor({ left: chart.valToPos(step, "x"), top: 0 });
    }
  }

  resize() {
    for (const chart of this.charts ?? []) {
      chart.setSize({ width: chart.root.parentElement.clientWidth, height: HEIGHT });
    }
    if (this.charts) this.show(this.step);
  }
}
