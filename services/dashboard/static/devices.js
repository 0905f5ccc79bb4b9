// Devices panel: the computer, then one line a root cause, then one row a stream, grouped by device.

import { cell, element, find, levelBadge, say, setText, shape, showChildren } from "./dom.js";
import { age, count, number } from "./format.js";
import { post } from "./requests.js";

const WIDTH = 88;
const HEIGHT = 16;
const TOP = 1.2;
const POINTS = 60;

// Corners of the lines through known values, the newest at the right edge.
function sparkPath(shares) {
  const shown = shares.slice(-POINTS);
  return shown.map((share, index) => {
    if (share === null) return "";
    const x = (WIDTH * (POINTS - shown.length + index)) / (POINTS - 1);
    const y = HEIGHT * (1 - Math.min(Math.max(share, 0), TOP) / TOP);
    return `${(shown[index - 1] ?? null) === null ? "M" : "L"}${x.toFixed(1)} ${y.toFixed(1)}`;
  }).join("");
}

function sparkline(shares) {
  const nominal = HEIGHT * (1 - 1 / TOP);
  const lines = [["nominal", `M0 ${nominal}H${WIDTH}`], ["shares", sparkPath(shares)]].map(([name, d]) => shape("path", { class: name, d }));
  return shape("svg", { class: "spark", viewBox: `0 0 ${WIDTH} ${HEIGHT}`, "aria-hidden": "true" }, ...lines);
}

function duration(value_s) {
  if (value_s === null || value_s < 120) return age(value_s);
  return value_s < 7200 ? `${Math.round(value_s / 60)} min` : `${Math.round(value_s / 3600)} h`;
}

function hostText(host) {
  const parts = [
    host.cpu_percent === null ? null : `CPU ${number(host.cpu_percent, 0)} %`,
    host.wake_ms === null ? null : `wakes ${number(host.wake_ms, host.wake_ms < 10 ? 1 : 0)} ms late`,
    host.disk_free_gb === null ? null : `${number(host.disk_free_gb, host.disk_free_gb < 10 ? 1 : 0)} GB free`,
    host.disk_left_s === null ? null : `${duration(host.disk_left_s)} of recording`,
  ];
  return parts.filter((part) => part !== null).join(" · ");
}

export class DevicesPanel {
  constructor() {
    this.faults = find("faults");
    this.faults.addEventListener("click", ({ target }) => target.name && this.setFault(target));
    this.body = find("device_rows");
    this.trends = {};
    // Causes that the operator unfolded, by key.
    this.open = new Set();
    this.streams = [];
    // Numbers of the causes that explain a stream, widest first.
    this.causesOf = new Map();
  }

  async setFault(button) {
    const on = button.getAttribute("aria-pressed") !== "true";
    const said = await post(`/v1/acquisition/faults/${button.name}`, { on }).then(() => "", (error) => error.message);
    setText(this.faults.querySelector("[role=alert]"), said);
  }

  show(station) {
    this.faults.hidden = !station.faults;
    for (const button of this.faults.querySelectorAll("button")) button.setAttribute("aria-pressed", String(station.faults?.includes(button.name)));
    this.causesOf.clear();
    station.causes.forEach(({ streams }, index) => streams.forEach((name) => this.causesOf.set(name, [...(this.causesOf.get(name) ?? []), index + 1])));
    find("devices_note").hidden = station.note === "";
    say(find("devices_note"), station.note, station.note_level);
    find("host").hidden = station.host === null;
    if (station.host) showChildren(find("host"), [levelBadge(station.host.level), element("span", { class: "quiet" }, hostText(station.host))]);
    showChildren(find("causes"), station.causes.map((cause, index) => this.cause(cause, index + 1)));
    this.streams = station.streams;
    this.showRows();
  }

  showTrends(trends) {
    this.trends = trends;
    this.showRows();
  }

  cause(cause, number) {
    const lasted = cause.lasted_s === null ? "" : ` · for ${duration(cause.lasted_s)}`;
    const streams = cause.streams.length > 1 ? ` · ${cause.streams.length} streams` : "";
    const line = [
      levelBadge(cause.level, `${number} ${cause.level}`),
      element("span", { class: "cause_text" },
        element("strong", {}, cause.message), element("span", { class: "quiet" }, lasted + streams),
        cause.advice ? element("span", { class: "to_do" }, cause.advice) : null),
    ];
    const attributes = { class: "cause", "data-level": cause.level, id: `cause_${number}` };
    if (!cause.findings.length) return element("div", attributes, ...line);
    const list = element("ul", {}, ...cause.findings.map((text) => element("li", {}, text)));
    const toggle = ({ target }) => this.open[target.open ? "add" : "delete"](cause.key);
    return element("details", { ...attributes, "data-key": cause.key, open: this.open.has(cause.key) ? "" : null, toggle }, element("summary", {}, ...line), list);
  }

  showRows() {
    const table = this.body.closest("table");
    table.classList.toggle("no_clocks", this.streams.every(({ skew_ppm, clock_error_ms }) => skew_ppm === null && clock_error_ms === null));
    table.hidden = this.streams.length === 0;
    const perDevice = new Map();
    for (const stream of this.streams) perDevice.set(stream.device, [...(perDevice.get(stream.device) ?? []), stream]);
    showChildren(this.body, [...perDevice].flatMap(([device, streams]) => this.group(device, streams)));
  }

  // A device of one stream is named beside it; one of several has a row above them.
  group(device, streams) {
    if (streams.length === 1) return [this.row(streams[0], device)];
    const head = element("tr", { class: "device_head" }, cell([device, element("span", { class: "quiet" }, ` ${streams.length} streams`)], null, { colspan: 8 }));
    return [head, ...streams.map((stream) => this.row(stream, ""))];
  }

  row(stream, device) {
    const about = [device, stream.note].filter((text) => text && text !== stream.name).join(" · ");
    const causes = this.causesOf.get(stream.name);
    // What a cause says is not said again in every row.
    return element("tr", { "data-level": stream.level, class: causes ? "explained" : null },
      cell(causes ? element("a", { class: "level", "data-level": stream.level, href: `#cause_${causes[0]}`, title: stream.level }, `cause ${causes.join(", ")}`)
        : levelBadge(stream.level)),
      cell(element("span", { class: "name_text", title: about || null }, stream.name, about ? element("span", { class: "quiet" }, ` ${about}`) : null), "name"),
      cell(sparkline(this.trends[stream.name] ?? []), "trend", { "data-level": stream.level }),
      cell(`${number(stream.rate_hz, 1)} / ${number(stream.nominal_rate_hz, 0)} Hz`, "number rate_text"),
      cell(stream.drop_percent === null ? count(stream.dropped) : `${number(stream.drop_percent, 2)} %`, "number", { title: `${stream.dropped} packets lost` }),
      cell(age(stream.age_s), "number"), cell(number(stream.skew_ppm, 1, "ppm"), "number clock_figure"), cell(number(stream.clock_error_ms, 2, "ms"), "number clock_figure"));
  }
}
