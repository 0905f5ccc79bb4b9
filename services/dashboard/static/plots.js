// Plots over time with one cursor: lines of a stream with its gaps, events and takes, and the strips of all streams.

import { css } from "./canvas.js";
import { date } from "./dates.js";
import uPlot from "./vendor/uplot/uPlot.esm.js";

const SYNC = uPlot.sync("health");
const LEVELS = ["--ok", "--warn", "--error", "--stale"];
const AXIS_WIDTH = 58;
const MAX_EVENT_LINES = 12;
export const ROW_HEIGHT = 19;
let selection = null;

export function levelColour(level) {
  return css(LEVELS[level] ?? "--quiet");
}

function timeAxis() {
  return { stroke: () => css("--quiet"), grid: { stroke: () => css("--line"), width: 1 }, ticks: { show: false }, font: "11px system-ui", size: 24, gap: 3, space: 80,
    values: (_, splits, __, ___, step_s) => splits.map((t_s) => date(t_s, step_s < 60 ? "time" : "minute")) };
}

function valueAxis(label, scale, side) {
  return { scale, side, label, labelSize: 16, labelFont: "11px system-ui", labelGap: 0, size: AXIS_WIDTH - 16, gap: 3, font: "11px system-ui", stroke: () => css("--quiet"),
    grid: { show: side === 3, stroke: () => css("--line"), width: 1 }, ticks: { show: false } };
}

// A cursor that all plots share; dragging selects a span of time.
function shared(onSelect, extra = {}) {
  return {
    cursor: { sync: { key: SYNC.key, scales: ["x", null] }, drag: { x: true, y: false, setScale: false }, points: { size: 6 }, y: false },
    scales: { x: { time: true } },
    hooks: { setSelect: [(plot) => {
      // The plots of the cursor all tell of one selection; what the first says counts.
      if (plot.select.width < 4) return;
      const [from_s, to_s] = [plot.select.left, plot.select.left + plot.select.width].map((x) => plot.posToVal(x, "x"));
      plot.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
      if (!selection) setTimeout(() => {
        const [start_s, stop_s] = selection;
        selection = null;
        onSelect(start_s, stop_s);
      });
      selection ??= [from_s, to_s];
    }], ...extra },
  };
}

function span(plot, start_s, stop_s) {
  const { min, max } = plot.scales.x;
  if (stop_s < min || start_s > max) return null;
  const left = plot.valToPos(Math.max(start_s, min), "x", true);
  return [left, Math.max(plot.valToPos(Math.min(stop_s, max), "x", true) - left, devicePixelRatio)];
}

function paint(plot, draw) {
  const { ctx, bbox } = plot;
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  draw(ctx, bbox);
  ctx.restore();
}

// Takes as bands, gaps of the stream in the colour of an error, events in that of their level: as lines, or as ticks where they are many.
function paintMarks(plot, marks) {
  paint(plot, (ctx, bbox) => {
    const bands = [...marks.takes.map((take) => [take.start_s, take.stop_s, "--accent", 0.1]), ...marks.gaps.map(([a, b]) => [a, b, "--error", 0.16])];
    for (const [start_s, stop_s, name, alpha] of bands) {
      const found = span(plot, start_s, stop_s);
      if (!found) continue;
      ctx.globalAlpha = alpha;
      ctx.fillStyle = css(name);
      ctx.fillRect(found[0], bbox.top, found[1], bbox.height);
    }
    const shown = marks.events.map((event) => [event, span(plot, event.t_s, event.t_s)]).filter(([, found]) => found);
    const length = shown.length > MAX_EVENT_LINES ? 7 * devicePixelRatio : bbox.height;
    ctx.globalAlpha = 0.8;
    ctx.setLineDash(shown.length > MAX_EVENT_LINES ? [] : [2 * devicePixelRatio, 3 * devicePixelRatio]);
    for (const [event, [left]] of shown) {
      ctx.strokeStyle = levelColour(event.level);
      ctx.beginPath();
      ctx.moveTo(left, bbox.top);
      ctx.lineTo(left, bbox.top + length);
      ctx.stroke();
    }
  });
}

// A plot of one or two series. `about`: title, series [{label, colour, scale, digits, unit}], nominal (a line), least (of the y axis).
export class LinePlot {
  constructor(root, about, { marks, onSelect }) {
    this.root = root;
    this.about = about;
    const scales = [...new Set(about.series.map((series) => series.scale))];
    const lines = about.series.map((series) => ({
      label: series.label, scale: series.scale, stroke: () => css(series.colour), width: 1.4, spanGaps: false,
      points: { show: false }, fill: series.fill ? () => `color-mix(in srgb, ${css(series.colour)} 18%, transparent)` : undefined,
      value: (_, value) => (value === null || value === undefined ? "–" : `${value.toFixed(series.digits)} ${series.unit}`),
    }));
    const base = shared(onSelect, { drawAxes: [(plot) => paintMarks(plot, marks())], draw: [(plot) => this.paintNominal(plot)] });
    this.plot = new uPlot({
      ...base, width: this.width(), height: about.height ?? 150,
      // Variables, so that the legend follows the theme as the lines do.
      legend: { live: true, markers: { stroke: (_, index) => `var(${about.series[index - 1]?.colour})`, fill: () => "transparent" } },
      scales: { ...base.scales, ...Object.fromEntries(scales.map((scale) => [scale, { range: (_, low, high) => this.range(low, high, scale) }])) },
      axes: [timeAxis(), ...scales.map((scale, index) => valueAxis(scale, scale, index === 0 ? 3 : 1))],
      // All plots of a column begin and end at the same place.
      padding: [6, scales.length > 1 ? 0 : AXIS_WIDTH, 0, 0],
      series: [{ label: "Time", value: (_, t_s) => (t_s === null ? "–" : date(t_s, "time")) }, ...lines],
    }, [[], ...lines.map(() => [])], root);
    root.plot = this.plot;
  }

  width() {
    return Math.max(this.root.clientWidth, 200);
  }

  range(low, high, scale) {
    const least = this.about.least?.[scale] ?? 1;
    if (low === null || high === null) return [0, least];
    if (low >= 0 && this.about.zero !== false) return [0, 1.08 * Math.max(high, least, this.nominal ?? 0)];
    const margin = Math.max(0.08 * (high - low), 0.5 * (least - (high - low)));
    return [low - margin, high + margin];
  }

  paintNominal(plot) {
    if (!this.nominal) return;
    paint(plot, (ctx, bbox) => {
      const y = plot.valToPos(this.nominal, this.about.series[0].scale, true);
      ctx.strokeStyle = css("--quiet");
      ctx.setLineDash([4 * devicePixelRatio, 4 * devicePixelRatio]);
      ctx.beginPath();
      ctx.moveTo(bbox.left, y);
      ctx.lineTo(bbox.left + bbox.width, y);
      ctx.stroke();
    });
  }

  show(data, [from_s, to_s], nominal = null) {
    this.nominal = nominal;
    this.plot.batch(() => {
      this.plot.setData(data, false);
      this.plot.setScale("x", { min: from_s, max: to_s });
    });
    // Without a cursor the legend shows the newest row.
    if (this.plot.cursor.left < 0 || this.plot.cursor.left === undefined) this.plot.setLegend({ idx: data[0].length - 1 });
  }

  resize() {
    this.plot.setSize({ width: this.width(), height: this.about.height ?? 150 });
  }
}

// One strip a row: its level as colour, its gaps as bars from below. `rows()`: [{name, levels, gaps}], `takes()`: as in History.
export class StripPlot {
  constructor(root, { rows, takes, onSelect, onPick }) {
    this.root = root;
    this.rows = rows;
    const base = shared(onSelect, { draw: [(plot) => this.paintStrips(plot, takes())] });
    this.plot = new uPlot({
      ...base, width: Math.max(root.clientWidth, 300), height: this.height(), legend: { show: false },
      scales: { ...base.scales, y: { dir: -1, range: () => [0, rows().length + 1] } },
      axes: [timeAxis(), { scale: "y", side: 3, size: 150, gap: 6, font: "12px system-ui", stroke: () => css("--ink"), grid: { show: false }, ticks: { show: false },
        splits: () => ["", ...rows()].map((_, index) => index + 0.5), values: () => ["takes", ...rows().map((row) => row.name)] }],
      padding: [2, 10, 0, 0],
      series: [{}, { scale: "y", show: true, stroke: "transparent", points: { show: false } }],
    }, [[], []], root);
    root.plot = this.plot;
    this.plot.over.addEventListener("click", (event) => {
      const index = Math.floor(event.offsetY / (this.plot.over.clientHeight / (rows().length + 1)));
      if (index > 0) onPick(rows()[index - 1].name);
    });
  }

  height() {
    return 28 + ROW_HEIGHT * (this.rows().length + 1);
  }

  paintStrips(plot, takes) {
    paint(plot, (ctx) => {
      const bar = (row, start_s, stop_s, share, name, alpha) => {
        const found = span(plot, start_s, stop_s);
        if (!found) return;
        const top = plot.valToPos(row, "y", true);
        const height = plot.valToPos(row + 1, "y", true) - top;
        ctx.globalAlpha = alpha;
        ctx.fillStyle = css(name);
        ctx.fillRect(found[0], top + height * (0.88 - 0.76 * share), found[1], 0.76 * height * share);
      };
      for (const take of takes) bar(0, take.start_s, take.stop_s, 1, "--accent", 0.75);
      this.rows().forEach((row, index) => {
        for (const [start_s, stop_s, level] of row.levels) bar(index + 1, start_s, stop_s, 1, LEVELS[level], level === 0 ? 0.28 : 0.6);
        for (const [start_s, stop_s, share] of row.gaps) bar(index + 1, start_s, stop_s, share, "--ink", 0.8);
      });
    });
  }

  show(times_s, [from_s, to_s]) {
    this.plot.batch(() => {
      this.plot.setData([times_s, times_s.map(() => null)], false);
      this.plot.setScale("x", { min: from_s, max: to_s });
    });
    if (this.plot.height !== this.height()) this.resize();
  }

  resize() {
    this.plot.setSize({ width: Math.max(this.root.clientWidth, 300), height: this.height() });
  }
}
