// Page of the history of a station's health: strips of all streams, plots of one, events; the view is in the URL.

import { date } from "./dates.js";
import { element, find, levelBadge, repeat, setText } from "./dom.js";
import { firstKnown, History, queryOf, runs, scaled, viewOf } from "./history.js";
import { unpack } from "./packed.js";
import { LinePlot, StripPlot } from "./plots.js";
import { ask, checked, pagePath } from "./session.js";
import { onTheme } from "./theme.js";

const PERIOD_MS = 1000;
const MAX_EVENTS = 2000;
const SHOWN_EVENTS = 200;
// A plot of fewer rows would show single samples.
const LEAST_RANGE_S = 30;
const LEVELS = ["OK", "WARN", "ERROR", "STALE"];
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
  const chooser = find("stream");
  const names = [...history.streams.keys()];
  if ([...chooser.options].map((option) => option.value).join() !== names.join()) {
    chooser.replaceChildren(...names.map((name) => element("option", { value: name }, name)));
  }
  chooser.value = view.stream;
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
  find("events").replaceChildren(...newest.map((event) => element("tr", {},
    element("td", {}, date(event.t_s, "time")), element("td", { class: "name" }, event.stream), element("td", {}, event.code),
    element("td", {}, event.level === 0 ? element("span", { class: "quiet" }, "ended") : levelBadge(LEVELS[event.level])))));
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

for (const button of document.querySelectorAll("[data-range]")) {
  button.addEventListener("click", () => go({ range_s: Number(button.dataset.range), end_s: null }));
}
find("stream").addEventListener("change", (event) => go({ stream: event.target.value }));
let resizing = 0;
window.addEventListener("resize", () => {
  cancelAnimationFrame(resizing);
  resizing = requestAnimationFrame(() => [overview, ...Object.values(plots)].forEach((plot) => plot.resize()));
});
onTheme(draw);
repeat(refresh, PERIOD_MS);
