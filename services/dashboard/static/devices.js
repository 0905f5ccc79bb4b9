// Health of every stream → table rows, updated in place so that the eye keeps its line.

import { element, levelBadge } from "./dom.js";
import { age, count, number } from "./format.js";

function rateCell(stream) {
  const nominal = stream.nominal_rate_hz;
  const children = [element("span", {}, `${number(stream.rate_hz, 1)} / ${number(nominal, 0)} Hz`)];
  if (nominal && stream.rate_hz !== null) {
    children.unshift(element("meter", {
      min: 0, max: 1.1 * nominal, low: 0.9 * nominal, high: 0.98 * nominal, optimum: nominal,
      value: Math.min(stream.rate_hz, 1.1 * nominal), "aria-hidden": "true",
    }));
  }
  return element("td", {}, element("span", { class: "rate" }, ...children));
}

function drops(stream) {
  const counted = count(stream.dropped);
  return stream.drop_percent === null ? counted : `${counted} (${number(stream.drop_percent, 2)} %)`;
}

function rows(stream) {
  const figures = element("tr", { "data-level": stream.level },
    element("td", {}, levelBadge(stream.level)),
    element("td", { class: "name" }, stream.name),
    rateCell(stream),
    element("td", { class: "number" }, drops(stream)),
    element("td", { class: "number" }, age(stream.age_s)),
    element("td", { class: "number clock_figure" }, number(stream.skew_ppm, 1, "ppm")),
    element("td", { class: "number clock_figure" }, number(stream.clock_error_ms, 2, "ms")),
  );
  if (!stream.message && !stream.advice) return [figures];
  const lasted = stream.lasted_s === null ? "" : ` · for ${age(stream.lasted_s)}`;
  const trouble = element("div", { class: "trouble" },
    stream.message ? element("span", { class: "why" }, stream.message + lasted) : null,
    stream.advice ? element("span", { class: "to_do" }, stream.advice) : null);
  // Below the figures, over the whole width: in the column of names it would be ten lines high.
  return [figures, element("tr", { "data-level": stream.level, class: "more" }, element("td", { colspan: 7 }, trouble))];
}

export function showDevices(body, note, station) {
  note.hidden = station.note === "";
  note.textContent = station.note;
  note.dataset.level = station.note_level;
  const clocks = station.streams.some((stream) => stream.skew_ppm !== null || stream.clock_error_ms !== null);
  body.closest("table").classList.toggle("no_clocks", !clocks);
  body.replaceChildren(...station.streams.flatMap(rows));
}
