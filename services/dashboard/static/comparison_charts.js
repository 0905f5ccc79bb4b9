// Errors over the steps of a comparison, and the uncertainty of the imagination below both videos: plots with one cursor.

import { css } from "./canvas.js";
import uPlot from "./vendor/uplot/uPlot.esm.js";

const HEIGHT = 150;
// Above it a share of the bound is drawn at the upper edge.
const MOST = 3;
const PLOTS = [
  { key: "pixel_error", label: "Pixel error", range: (max) => [0, Math.max(max, 5)] },
  { key: "pressure_error_kpa", label: "Pressure error, kPa", range: (max) => [0, Math.max(max, 0.2)] },
  { key: "contact_f1", label: "Contact F1", range: () => [0, 1] },
];
const STRIP = { key: "uncertainty", label: "Uncertainty of the world model, as a share of its bound", range: (max) => [0, Math.min(MOST, Math.max(1.3, max))], isStrip: true };

// Values of a plot; F1 says nothing where neither world has contact, and the start is given, not imagined.
export function series(view, key) {
  if (key === "contact_f1") return view.contact_f1.map((value, step) => (view.in_contact[step] ? value : null));
  if (key !== "uncertainty") return view[key];
  return [null, ...view.uncertainties.flatMap((one) => Array(one.last_step - one.first_step + 1).fill(one.bound_share === null ? null : Math.min(MOST, one.bound_share)))];
}

export class ComparisonCharts {
  constructor(frame, strip, onStep) {
    this.frames = [[frame, PLOTS, HEIGHT], [strip, [STRIP], 130]];
    this.onStep = onStep;
    this.view = null;
    this.step = 0;
    this.plots = [];
    const observer = new ResizeObserver(() => this.rebuild());
    observer.observe(frame);
    observer.observe(strip);
  }

  rebuild() {
    for (const { made } of this.plots) made.destroy();
    this.plots = this.view ? this.frames.flatMap(([frame, plots, height]) => {
      const width = Math.floor(frame.clientWidth / plots.length) - (plots.length > 1 ? 12 : 0);
      return width > 120 ? plots.map((plot) => ({ key: plot.key, made: this.plot(plot, width, height, frame) })) : [];
    }) : [];
  }

  plot({ key, label, range, isStrip }, width, height, frame) {
    const axis = { stroke: css("--quiet"), grid: { stroke: css("--line"), width: 1 }, ticks: { stroke: css("--line") }, size: 42 };
    const time = isStrip ? { values: (_, steps) => steps.map((step) => `${(step / this.view.rate_hz).toFixed(1)} s`) } : {};
    const made = new uPlot({
      width, height, title: label, legend: { show: false }, cursor: { drag: { x: false, y: false }, y: false },
      scales: { x: { time: false, range: () => [0, Math.max(1, this.view.num_steps)] }, y: { range: (_, low, high) => range(high ?? 0) } },
      axes: [{ ...axis, size: 28, ...time }, axis],
      series: [{}, { stroke: css("--accent"), width: 1.8, points: { show: false } }],
      hooks: { drawClear: [(plot) => this.shade(plot)], draw: [(plot) => this.mark(plot, isStrip)] },
    }, this.data(key), frame);
    made.over.addEventListener("click", () => this.onStep(made.posToIdx(made.cursor.left)));
    made.root.dataset.figure = key;
    return made;
  }

  data(key) {
    const values = series(this.view, key);
    return [values.map((_, step) => step), values];
  }

  band(plot, from, to, colour) {
    const left = plot.valToPos(from, "x", true);
    plot.ctx.fillStyle = colour;
    plot.ctx.fillRect(left, plot.bbox.top, Math.max(1.5, plot.valToPos(to, "x", true) - left), plot.bbox.height);
  }

  // From the first unreliable chunk on, since every later step goes on from it.
  get left() {
    return this.view.uncertainties.find(({ uncertainty }) => uncertainty?.outside)?.first_step ?? null;
  }

  shade(plot) {
    if (this.left !== null) this.band(plot, this.left, this.view.uncertainties.at(-1).last_step, css("--warn_ground"));
  }

  mark(plot, isStrip) {
    if (this.left !== null) this.band(plot, this.left, this.left, css("--warn"));
    if (isStrip) {
      plot.ctx.fillStyle = css("--warn");
      for (let x = plot.bbox.left; x < plot.bbox.left + plot.bbox.width; x += 8) plot.ctx.fillRect(x, plot.valToPos(1, "y", true), 4, 1.5);
    }
    this.band(plot, this.step, this.step, css("--ink"));
  }

  show(view) {
    const other = this.view?.id !== view.id || this.plots.length === 0;
    this.view = view;
    if (other) this.rebuild();
    else for (const { key, made } of this.plots) made.setData(this.data(key));
  }

  goTo(step) {
    this.step = step;
    for (const { made } of this.plots) made.redraw(false);
  }
}
