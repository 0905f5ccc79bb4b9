// Plots of signals over the visible part of the timeline; a recording's raw signal lies over the
// aligned one. Values are the lowest and highest of each bin, so that no peak is lost.

import { css } from "../canvas.js";
import { button, element, setText } from "../dom.js";
import uPlot from "../vendor/uplot/uPlot.esm.js";

const GAP_PERIODS = 1.5;

// Centres of the bins, in seconds for the axis.
export function binCentres(start_ns, stop_ns, points) {
  const step_ns = (stop_ns - start_ns) / points;
  return Array.from({ length: points }, (_, k) => (start_ns + (k + 0.5) * step_ns) / 1e9);
}

// Values of bins as uPlot wants them: null where a gap begins, which breaks the line; undefined in
// bins that are merely shorter than the time between two samples, which the line crosses.
export function withGaps(values, bin_ns, period_ns) {
  const longest = Math.floor((GAP_PERIODS * period_ns) / bin_ns) + 1;
  const found = Array.from(values, (value) => (Number.isNaN(value) ? undefined : value));
  let last = -1;
  for (let k = 0; k <= found.length; k += 1) {
    if (k < found.length && found[k] === undefined) continue;
    const isGap = last < 0 || k === found.length || k - last > longest;
    if (isGap) for (let empty = last + 1; empty < k; empty += 1) found[empty] = null;
    last = k;
  }
  return found;
}

// Parts of the name of a signal: "action.3" is value 3 of the stream "action".
export function signalParts(name) {
  const dot = name.indexOf(".");
  return dot < 0 ? { stream: name, what: "" } : { stream: name.slice(0, dot), what: name.slice(dot + 1) };
}

// The name of a value with its unit: "l_thumb_mcp_rad" is "left thumb mcp" in rad.
export function componentWords(name) {
  const [, text, unit = ""] = /^(.*?)(?:_(m|rad))?$/.exec(name);
  return { text: text.replace(/^([lr])_/, (_, side) => (side === "l" ? "left " : "right ")).replace(/[._]/g, " "), unit };
}

// Title and unit of a signal.
function signalWords(name, streams) {
  const { stream, what } = signalParts(name);
  const { components, unit } = streams.get(stream);
  if (what === "interval_ms") return { title: `${stream}, time between samples`, unit: "ms" };
  if (!components[what]) return { title: name, unit };
  const words = componentWords(components[what]);
  return { title: `${stream}: ${words.text}`, unit: words.unit };
}

export function isSignal(name, streams) {
  const { stream, what } = signalParts(name);
  const found = streams.get(stream);
  if (!found) return false;
  if (what === "interval_ms") return true;
  if (found.kind === "image") return false;
  const size = found.shape.reduce((product, axis) => product * axis, 1);
  return !what || what === "max" || (/^\d{1,6}$/.test(what) && Number(what) < size);
}

const HEIGHT_PX = 110;
const MAX_POINTS = 2000;
const MAX_PER_REQUEST = 16;
const DELAY_MS = 120;
const FONT = "11px system-ui";

function sizeOf(root, name) {
  return parseFloat(getComputedStyle(root).getPropertyValue(name));
}

export class Plots {
  // `raw` is the recording on the episode's time, or null.
  constructor(root, item, { onSeek, onRemove, rawName }) {
    Object.assign(this, { root, item, rawName, onSeek, onRemove, raw: null, plots: new Map(), abort: null, range: [item.start_ns, item.stop_ns], t_ns: item.start_ns });
    new ResizeObserver(() => this.resize()).observe(root);
  }

  setSignals(names) {
    for (const [name, plot] of this.plots) {
      if (names.includes(name)) continue;
      plot.chart?.destroy();
      plot.root.remove();
      this.plots.delete(name);
    }
    for (const name of names) if (!this.plots.has(name)) this.plots.set(name, this.made(name));
    this.root.append(...names.map((name) => this.plots.get(name).root));
    this.refresh();
  }

  made(name) {
    const note = element("span", { class: "plot_note" });
    const { title } = signalWords(name, this.item.streams);
    const remove = button("×", () => this.onRemove(name), { class: "plain", title: `Remove the plot of ${title}`, "aria-label": `Remove ${title}` });
    const head = element("div", { class: "playhead" });
    const body = element("div", { class: "plot_body" });
    const root = element("div", { class: "plot", "data-signal": name, "data-state": "loading" },
      element("p", { class: "plot_title" }, element("span", { class: "name" }, title), note, remove), body, element("div", { class: "over" }, head));
    return { name, root, body, head, note, chart: null };
  }

  setRaw(raw) {
    this.raw = raw;
    for (const plot of this.plots.values()) {
      plot.chart?.destroy();
      plot.chart = null;
    }
    this.refresh();
  }

  setRange(range) {
    this.range = range;
    this.show(this.t_ns);
    this.refresh();
  }

  refresh() {
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.load(), DELAY_MS);
  }

  show(t_ns) {
    this.t_ns = t_ns;
    const [from_ns, to_ns] = this.range;
    for (const { head } of this.plots.values()) {
      head.hidden = t_ns < from_ns || t_ns > to_ns;
      head.style.left = `${(100 * (t_ns - from_ns)) / (to_ns - from_ns)}%`;
    }
  }

  get inner_px() {
    return Math.max(50, this.root.clientWidth - sizeOf(this.root, "--gutter_left") - sizeOf(this.root, "--gutter_right"));
  }

  async load() {
    if (!this.plots.size) return;
    this.abort?.abort();
    const abort = (this.abort = new AbortController());
    const span = { start_ns: this.range[0], stop_ns: this.range[1] + 1 };
    const points = Math.round(Math.min(this.inner_px, MAX_POINTS));
    const names = [...this.plots.keys()];
    for (let first = 0; first < names.length; first += MAX_PER_REQUEST) {
      await this.loadSome(names.slice(first, first + MAX_PER_REQUEST), span, points, abort.signal);
    }
  }

  async loadSome(names, span, points, signal) {
    const raw_names = this.raw ? new Map(names.map((name) => [name, this.rawName(this.raw, name)]).filter(([, raw]) => raw)) : new Map();
    const read = (item, wanted) => (wanted.length ? item.signals([...new Set(wanted)], span, points, signal).catch((error) => error) : new Map());
    const [own, raw] = await Promise.all([read(this.item, names), read(this.raw, [...raw_names.values()])]);
    if (signal.aborted) return;
    for (const name of names) {
      const plot = this.plots.get(name);
      if (!plot) continue;
      if (own instanceof Error) {
        plot.root.dataset.state = "failed";
        setText(plot.note, own.message);
        continue;
      }
      const theirs = raw instanceof Error ? null : raw.get(raw_names.get(name));
      const reason = raw instanceof Error ? raw.message : "not in the recording";
      this.draw(plot, { span, points, own: own.get(name), raw: theirs, reason: this.raw && !theirs ? reason : "" });
    }
  }

  draw(plot, { span, points, own, raw, reason }) {
    const { stream } = signalParts(plot.name);
    const bin_ns = (span.stop_ns - span.start_ns) / points;
    const curves = ({ low, high }, item) => {
      const { period_ns } = item.streams.get(stream);
      return [withGaps(low, bin_ns, period_ns), withGaps(high, bin_ns, period_ns)];
    };
    const { unit } = signalWords(plot.name, this.item.streams);
    const raw_unit = raw ? signalWords(plot.name, this.raw.streams).unit : "";
    const data = [binCentres(span.start_ns, span.stop_ns, points), ...curves(own, this.item), ...(raw ? curves(raw, this.raw) : [])];
    if (!plot.chart || plot.has_raw !== Boolean(raw)) {
      plot.chart?.destroy();
      plot.chart = this.chart(plot, data, { has_raw: Boolean(raw), has_own_scale: unit !== raw_unit, unit, raw_unit });
      plot.has_raw = Boolean(raw);
    }
    plot.chart.setData(data, false);
    plot.chart.setScale("x", { min: this.range[0] / 1e9, max: this.range[1] / 1e9 });
    for (const scale of raw && unit !== raw_unit ? ["y", "raw"] : ["y"]) plot.chart.setScale(scale, { min: null, max: null });
    plot.root.dataset.state = "shown";
    const what = raw ? `${unit}, raw ${raw_unit} in grey` : unit;
    setText(plot.note, reason ? `${unit} (raw: ${reason})` : what);
  }

  chart(plot, data, { has_raw, has_own_scale, unit, raw_unit }) {
    const curve = (colour, scale, width = 1.25) => ({ scale, stroke: () => css(colour), width, points: { show: false }, spanGaps: false });
    const raw_scale = has_own_scale ? "raw" : "y";
    const axis = (axis_unit, gutter, more) => ({ values: (_, splits) => splits.map((value) => `${Number(value.toPrecision(6))} ${axis_unit}`), size: sizeOf(this.root, gutter), font: FONT, stroke: () => css("--quiet"), grid: { stroke: () => css("--line"), width: 1 }, ticks: { show: false }, ...more });
    const right = has_raw && has_own_scale;
    const chart = new uPlot({
      width: this.root.clientWidth,
      height: HEIGHT_PX,
      padding: [6, right ? 0 : sizeOf(this.root, "--gutter_right"), 6, 0],
      legend: { show: false },
      cursor: { drag: { x: false, y: false }, points: { show: false } },
      scales: { x: { time: false, auto: false }, y: {}, ...(right ? { raw: {} } : {}) },
      axes: [
        axis("", "--gutter_left", { size: 0, values: () => [] }),
        axis(unit, "--gutter_left", { scale: "y" }),
        ...(right ? [axis(raw_unit, "--gutter_right", { scale: "raw", side: 1, grid: { show: false } })] : []),
      ],
      series: [{}, curve("--accent", "y"), curve("--accent", "y"),
        ...(has_raw ? [curve("--quiet", raw_scale), curve("--quiet", raw_scale)] : [])],
      bands: [{ series: [2, 1], fill: () => css("--accent_ground") }, ...(has_raw ? [{ series: [4, 3], fill: () => css("--raw_ground") }] : [])],
    }, data, plot.body);
    chart.over.addEventListener("click", () => this.onSeek(chart.posToVal(chart.cursor.left, "x") * 1e9));
    return chart;
  }

  resize() {
    for (const { chart } of this.plots.values()) chart?.setSize({ width: this.root.clientWidth, height: HEIGHT_PX });
    this.refresh();
  }

  recolour() {
    for (const { chart } of this.plots.values()) chart?.redraw();
  }
}
