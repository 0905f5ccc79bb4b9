// Page of the history of a station's health: strips of all streams, plots of one, events; the view is in the URL.

import { css } from "./canvas.js";
import { cell, element, find, levelBadge, repeat, setText, showChildren } from "./dom.js";
import { date } from "./format.js";
import { unpack } from "./packed.js";
import { ask, checked, pagePath } from "./requests.js";
import { onTheme } from "./theme.js";
import uPlot from "./vendor/uplot/uPlot.esm.js";

const MAX_ROWS = 3600;

class History {
  constructor() {
    this.clear();
  }

  // `offset_s` is the wall clock minus the station's clock.
  clear() {
    Object.assign(this, { times_s: [], newest_ns: -1n, station: {}, streams: new Map(), nominal_hz: {}, takes: [], offset_s: 0 });
  }

  // Adds rows of an answer; false where they do not continue the present ones, which are dropped then.
  append({ fields, arrays }) {
    const t_ns = arrays.t_ns.values;
    const offset_s = fields.now_unix_s - fields.now_ns / 1e9;
    const last_s = this.times_s.at(-1) ?? -Infinity;
    const first_s = t_ns.length ? Number(t_ns[0]) / 1e9 + offset_s : Infinity;
    if (fields.now_ns < Number(this.newest_ns) || first_s <= last_s) {
      this.clear();
      return false;
    }
    this.offset_s = offset_s;
    this.nominal_hz = fields.nominal_rate_hz;
    this.takes = fields.takes.map((take) => ({ name: take.recording_id, start_s: take.start_ns / 1e9 + offset_s,
      stop_s: take.stop_ns === null ? Infinity : take.stop_ns / 1e9 + offset_s }));
    for (const t of t_ns) this.times_s.push(Number(t) / 1e9 + offset_s);
    if (t_ns.length) this.newest_ns = t_ns.at(-1);
    const num_rows = t_ns.length;
    const add = (columns, names, values, start) => names.forEach((name, index) => {
      const column = (columns[name] ??= []);
      const first = start + index * num_rows;
      // A plot leaves null out; it would draw through NaN.
      for (let row = first; row < first + num_rows; row += 1) column.push(Number.isNaN(values[row]) ? null : values[row]);
    });
    add(this.station, fields.station_series, arrays.station.values, 0);
    Object.keys(fields.nominal_rate_hz).forEach((name, index) => {
      if (!this.streams.has(name)) this.streams.set(name, {});
      const start = index * fields.stream_series.length * num_rows;
      add(this.streams.get(name), fields.stream_series, arrays.streams.values, start);
    });
    this.forget();
    return true;
  }

  forget() {
    const excess = this.times_s.length - MAX_ROWS;
    if (excess <= 0) return;
    for (const columns of [{ times: this.times_s }, this.station, ...this.streams.values()]) {
      for (const column of Object.values(columns)) column.splice(0, excess);
    }
  }

  column(stream, name) {
    return this.streams.get(stream)?.[name] ?? [];
  }
}

// Column in another unit; `from` is taken off each value.
function scaled(column, factor, from = 0) {
  return column.map((value) => (value === null ? null : factor * (value - from)));
}

// First known value of the rows from `start_s` on, 0 if there is none.
function firstKnown(times_s, column, start_s) {
  const index = times_s.findIndex((t_s, row) => t_s >= start_s && column[row] !== null);
  return index < 0 ? 0 : column[index];
}

// Times that a value stays: [start, stop, value]. A row is what was measured until its time.
function runs(times_s, column, longest_s = 3) {
  const found = [];
  times_s.forEach((t_s, row) => {
    const before_s = times_s[row - 1] ?? t_s - 1;
    const start_s = Math.max(before_s, t_s - longest_s);
    const last = found.at(-1);
    if (last && last[2] === column[row] && last[1] === start_s) last[1] = t_s;
    else found.push([start_s, t_s, column[row]]);
  });
  return found.filter(([, , value]) => value !== null && value !== undefined);
}

// What a page shows, as a query: a length in seconds up to now, or up to `end_s`.
function viewOf(query, defaults) {
  const parameters = new URLSearchParams(query);
  const read = (name) => (parameters.has(name) && Number.isFinite(Number(parameters.get(name))) ? Number(parameters.get(name)) : null);
  const range_s = read("range");
  return { stream: parameters.get("stream") ?? defaults.stream, end_s: read("end"),
    range_s: range_s === null ? defaults.range_s : Math.min(Math.max(range_s, 10), 3600) };
}

function queryOf({ stream, range_s, end_s }) {
  const parameters = new URLSearchParams({ stream, range: String(Math.round(range_s)) });
  if (end_s !== null) parameters.set("end", end_s.toFixed(0));
  return `?${parameters}`;
}

const SYNC = uPlot.sync("health");
const LEVELS = ["OK", "WARN", "ERROR", "STALE"];
const LEVEL_COLOURS = ["--ok", "--warn", "--error", "--stale"];
const AXIS_WIDTH = 58;
const MAX_EVENT_LINES = 12;
const ROW_HEIGHT = 19;
let selection = null;

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
      ctx.strokeStyle = css(LEVEL_COLOURS[event.level] ?? "--quiet");
      ctx.beginPath();
      ctx.moveTo(left, bbox.top);
      ctx.lineTo(left, bbox.top + length);
      ctx.stroke();
    }
  });
}

// A plot of one or two series. `about`: title, series [{label, colour, scale, digits, unit}], nominal (a line), least (of the y axis).
class LinePlot {
  constructor(root, about, { marks, onSelect }) {
    Object.assign(this, { root, about });
    const scales = [...new Set(about.series.map((series) => series.scale))];
    const lines = about.series.map((series) => ({
      label: series.label, scale: series.scale, stroke: () => css(series.colour), width: 1.4, spanGaps: false,
      points: { show: false }, fill: series.fill ? () => `color-mix(in srgb, ${css(series.colour)} 18%, transparent)` : undefined,
      value: (_, value) => (value === null || value === undefined ? "–" : `${value.toFixed(series.digits)} ${series.unit}`),
    }));
    const base = shared(onSelect, { drawAxes: [(plot) => paintMarks(plot, marks())], draw: [(plot) => this.paintNominal(plot)] });
    this.plot = new uPlot({
      ...base, ...this.size(),
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

  size() {
    return { width: Math.max(this.root.clientWidth, 200), height: this.about.height ?? 150 };
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
    this.plot.setSize(this.size());
  }
}

// One strip a row: its level as colour, its gaps as bars from below. `rows()`: [{name, levels, gaps}], `takes()`: as in History.
class StripPlot {
  constructor(root, { rows, takes, onSelect, onPick }) {
    Object.assign(this, { root, rows });
    const base = shared(onSelect, { draw: [(plot) => this.paintStrips(plot, takes())] });
    this.plot = new uPlot({
      ...base, ...this.size(), legend: { show: false },
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

  size() {
    return { width: Math.max(this.root.clientWidth, 300), height: 28 + ROW_HEIGHT * (this.rows().length + 1) };
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
        for (const [start_s, stop_s, level] of row.levels) bar(index + 1, start_s, stop_s, 1, LEVEL_COLOURS[level], level === 0 ? 0.28 : 0.6);
        for (const [start_s, stop_s, share] of row.gaps) bar(index + 1, start_s, stop_s, share, "--ink", 0.8);
      });
    });
  }

  show(times_s, [from_s, to_s]) {
    this.plot.batch(() => {
      this.plot.setData([times_s, times_s.map(() => null)], false);
      this.plot.setScale("x", { min: from_s, max: to_s });
    });
    if (this.plot.height !== this.size().height) this.resize();
  }

  resize() {
    this.plot.setSize(this.size());
  }
}

const PERIOD_MS = 1000;
const MAX_EVENTS = 2000;
const SHOWN_EVENTS = 200;
// A plot of fewer rows would show single samples.
const LEAST_RANGE_S = 30;
const STATION = "station";

const history = new History();
let events = [];
let view = viewOf(location.search, { stream: "", range_s: 900 });
let marks = { takes: [], gaps: [], events: [] };
let strips = [];

const PLOTS = {
  rate: { series: [{ label: "rate", colour: "--accent", scale: "Hz", digits: 1, unit: "Hz" }] },
  loss: { series: [{ label: "lost", colour: "--error", scale: "%", digits: 2, unit: "%", fill: true }], least: { "%": 1 } },
  interval: { series: [
    { label: "95 %", colour: "--accent", scale: "ms", digits: 1, unit: "ms" },
    { label: "longest", colour: "--error", scale: "ms", digits: 1, unit: "ms" }] },
  clock: { zero: false, least: { ms: 0.5, ppm: 20 }, series: [
    { label: "offset", colour: "--accent", scale: "ms", digits: 2, unit: "ms" },
    { label: "drift", colour: "--ok", scale: "ppm", digits: 1, unit: "ppm" }] },
  residual: { series: [{ label: "clock residual", colour: "--accent", scale: "ms", digits: 2, unit: "ms" }], least: { ms: 4 } },
  buffer: { least: { "%": 100, s: 0.5 }, series: [
    { label: "buffer fill", colour: "--ok", scale: "%", digits: 0, unit: "%" },
    { label: "age", colour: "--accent", scale: "s", digits: 2, unit: "s" }] },
  host: { least: { "%": 100, ms: 20 }, series: [
    { label: "CPU", colour: "--accent", scale: "%", digits: 0, unit: "%" },
    { label: "threads wake late", colour: "--error", scale: "ms", digits: 1, unit: "ms" }] },
  disk: { series: [{ label: "disk free", colour: "--ok", scale: "GB", digits: 1, unit: "GB" }] },
};

function hostMarks() {
  return { takes: marks.takes, gaps: [], events: marks.events.filter((event) => event.stream === STATION) };
}

function select(from_s, to_s) {
  go({ range_s: to_s - from_s, end_s: to_s });
}

const plots = Object.fromEntries(Object.entries(PLOTS).map(([name, about]) =>
  [name, new LinePlot(find(`plot_${name}`), about, { marks: () => (["host", "disk"].includes(name) ? hostMarks() : marks), onSelect: select })]));
const overview = new StripPlot(find("overview"), { rows: () => strips, takes: () => history.takes, onSelect: select,
  onPick: (name) => { if (name !== STATION) go({ stream: name }); } });

function go(change) {
  view = { ...view, ...change };
  window.history.replaceState(null, "", pagePath(queryOf(view)));
  draw();
}

function range() {
  const end_s = view.end_s ?? history.times_s.at(-1) ?? Date.now() / 1000;
  const start_s = end_s - view.range_s;
  // What is live begins with its first row: a station that just started fills the plots.
  const first_s = view.end_s === null ? history.times_s[0] ?? start_s : start_s;
  return [Math.min(Math.max(start_s, first_s), end_s - Math.min(LEAST_RANGE_S, view.range_s)), end_s];
}

function data(name) {
  const column = (series) => history.column(view.stream, series);
  const offset = column("clock_offset_s");
  const columns = {
    rate: [column("rate_hz")],
    loss: [scaled(column("loss_ratio"), 100)],
    interval: [scaled(column("interval_p95_s"), 1e3), scaled(column("interval_max_s"), 1e3)],
    // Since the first value that is shown: an hour of drift would hide a step.
    clock: [scaled(offset, 1e3, firstKnown(history.times_s, offset, range()[0])), column("clock_skew_ppm")],
    residual: [scaled(column("clock_residual_s"), 1e3)],
    buffer: [scaled(column("buffer_ratio"), 100), column("age_s")],
    host: [scaled(history.station.cpu_ratio ?? [], 100), scaled(history.station.wake_p90_s ?? [], 1e3)],
    disk: [scaled(history.station.disk_free_bytes ?? [], 1e-9)],
  }[name];
  return [history.times_s, ...columns];
}

function draw() {
  if (!history.streams.has(view.stream)) view.stream = history.streams.keys().next().value ?? view.stream;
  const shown = range();
  const gapsOf = (column) => runs(history.times_s, column).filter(([, , share]) => share > 0);
  strips = [[STATION, history.station], ...history.streams].map(([name, columns]) => (
    { name, levels: runs(history.times_s, columns.level ?? []), gaps: gapsOf(columns.gap_ratio ?? []) }));
  marks = { takes: history.takes, gaps: gapsOf(history.column(view.stream, "gap_ratio")),
    events: events.filter((event) => [view.stream, STATION].includes(event.stream)) };
  overview.show(history.times_s, shown);
  for (const [name, plot] of Object.entries(plots)) plot.show(data(name), shown, name === "rate" ? history.nominal_hz[view.stream] : null);
  showControls();
  showEvents(shown);
}

function showControls() {
  showChildren(find("stream"), [...history.streams.keys()].map((name) => element("option", { value: name }, name)));
  find("stream").value = view.stream;
  for (const button of document.querySelectorAll("[data-range]")) {
    button.setAttribute("aria-pressed", String(view.end_s === null && Number(button.dataset.range) === view.range_s));
  }
  const [from_s, to_s] = range();
  setText(find("span"), view.end_s === null ? "live" : `${date(from_s)} – ${date(to_s, "time")}`);
}

function showEvents([from_s, to_s]) {
  const inside = events.filter((event) => event.t_s >= from_s && event.t_s <= to_s);
  const newest = inside.slice(-SHOWN_EVENTS).reverse();
  find("no_events").hidden = newest.length > 0;
  const key = newest.map((event) => event.key).join();
  if (find("events").dataset.key === key) return;
  find("events").dataset.key = key;
  find("events").replaceChildren(...newest.map((event) => element("tr", {}, cell(date(event.t_s, "time")), cell(event.stream, "name"), cell(event.code),
    cell(event.level === 0 ? element("span", { class: "quiet" }, "ended") : levelBadge(LEVELS[event.level])))));
}

async function read(path) {
  return checked(await ask(path, { signal: AbortSignal.timeout(10_000) }));
}

async function update() {
  const since = history.newest_ns + 1n;
  const rows = unpack(await (await read(`/v1/acquisition/health/history?format=msgpack&limit=3600&since_ns=${since}`)).arrayBuffer());
  if (!history.append(rows)) {
    events = [];
    return;
  }
  const since_ns = (events.at(-1)?.t_ns ?? -1) + 1;
  const found = await (await read(`/v1/acquisition/health/events?since_ns=${since_ns}`)).json();
  for (const event of found.events) {
    events.push({ t_ns: event.t_host_ns, t_s: event.t_host_ns / 1e9 + history.offset_s, stream: event.stream, code: event.code,
      level: LEVELS.indexOf(event.level), key: `${event.t_host_ns} ${event.stream} ${event.code}` });
  }
  events = events.slice(-MAX_EVENTS);
}

async function refresh() {
  try {
    await update();
    setText(find("link"), "");
    draw();
  } catch (error) {
    setText(find("link"), `No answer, trying again: ${error.message}`);
  }
}

for (const one of document.querySelectorAll("[data-range]")) one.addEventListener("click", () => go({ range_s: Number(one.dataset.range), end_s: null }));
find("stream").addEventListener("change", (event) => go({ stream: event.target.value }));
let resizing = 0;
window.addEventListener("resize", () => {
  cancelAnimationFrame(resizing);
  resizing = requestAnimationFrame(() => [overview, ...Object.values(plots)].forEach((plot) => plot.resize()));
});
onTheme(draw);
repeat(refresh, PERIOD_MS);
