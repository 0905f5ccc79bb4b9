// Errors over the steps of a comparison: three plots with one cursor, shaded where imagination is unreliable.

import { css } from "./canvas.js";
import uPlot from "./vendor/uplot/uPlot.esm.js";

const HEIGHT = 150;
const PLOTS = [
  { key: "pixel_error", label: "Pixel error", range: (max) => [0, Math.max(max, 5)] },
  { key: "pressure_error_kpa", label: "Pressure error, kPa", range: (max) => [0, Math.max(max, 0.2)] },
  { key: "contact_f1", label: "Contact F1", range: () => [0, 1] },
];

// Values of a plot; F1 says nothing where neither world has contact.
export function series(view, key) {
  return key === "contact_f1" ? view.contact_f1.map((value, step) => (view.in_contact[step] ? value : null)) : view[key];
}

export class ComparisonCharts {
  constructor(frame, onStep) {
    this.frame = frame;
    this.onStep = onStep;
    this.view = null;
    this.step = 0;
    this.plots = [];
    new ResizeObserver(() => this.rebuild()).observe(frame);
  }

  rebuild() {
    for (const plot of this.plots) plot.destroy();
    const width = Math.floor(this.frame.clientWidth / PLOTS.length) - 12;
    this.plots = this.view && width > 120 ? PLOTS.map((plot) => this.plot(plot, width)) : [];
  }

  plot({ key, label, range }, width) {
    const axis = { stroke: css("--quiet"), grid: { stroke: css("--line"), width: 1 }, ticks: { stroke: css("--line") }, size: 42 };
    const made = new uPlot({
      width, height: HEIGHT, title: label, legend: { show: false }, cursor: { drag: { x: false, y: false }, y: false },
      scales: { x: { time: false, range: () => [0, Math.max(1, this.view.num_steps)] }, y: { range: (_, low, high) => range(high ?? 0) } },
      axes: [{ ...axis, size: 28 }, axis],
      series: [{}, { stroke: css("--accent"), width: 1.8, points: { show: false } }],
      hooks: { drawClear: [(plot) => this.shade(plot)], draw: [(plot) => this.mark(plot)] },
    }, this.data(key), this.frame);
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

  shade(plot) {
    for (const { first_step, last_step, uncertainty } of this.view.uncertainties) {
      if (uncertainty?.outside) this.band(plot, first_step, last_step, css("--warn_ground"));
    }
  }

  mark(plot) {
    this.band(plot, this.step, this.step, css("--ink"));
  }

  show(view) {
    const other = this.view?.id !== view.id || this.plots.length === 0;
    this.view = view;
    if (other) this.rebuild();
    else this.plots.forEach((plot, index) => plot.setData(this.data(PLOTS[index].key)));
  }

  goTo(step) {
    this.step = step;
    for (const plot of this.plots) plot.redraw(false);
  }
}
