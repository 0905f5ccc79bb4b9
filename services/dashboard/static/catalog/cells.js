// Cells of a row: what is known of an item, as an operator reads it.

import { date } from "../dates.js";
import { element, levelBadge } from "../dom.js";
import { number } from "../format.js";
import { STEPS } from "./stage.js";

const OUTCOMES = new Map([[true, "success"], [false, "failure"], [null, "not judged"]]);
const CONSENT = new Map([[true, "consent given"], [false, "no consent"], [null, "consent not known"]]);
const QUALITY = [
  ["coverage", (value) => `${number(100 * value, 1)} % kept`],
  ["clock_residual_ms", (value) => `clock ${number(value, 2)} ms`],
  ["num_gaps", (value) => (value > 0 ? `${value} ${value === 1 ? "gap" : "gaps"}` : null)],
  ["lost_share", (value) => (value > 0 ? `${number(100 * value, 2)} % lost` : null)],
  ["tip_error_mm", (value) => `tips ${number(value, 1)} mm`],
  ["largest_gap_s", (value) => `largest gap ${number(value, 2)} s`],
];
const MAX_FINDINGS = 2;

export function under(text, kind = "why") {
  return text ? element("span", { class: kind }, text) : null;
}

export function length(value_s) {
  if (value_s < 60) return `${number(value_s, 1)} s`;
  return `${Math.floor(value_s / 60)}:${String(Math.floor(value_s % 60)).padStart(2, "0")} min`;
}

export function timeCell(at) {
  return element("td", {}, date(at, "day"), under(at ? date(at, "time") : ""));
}

export function taskCell(item) {
  const words = element("span", { class: "why clipped" }, item.instruction);
  words.title = item.instruction;
  return element("td", { class: "task" }, element("strong", { class: "clipped" }, item.task), words);
}

export function nameCell(item, path) {
  const kind = item.kind === "recording" && item.episodes.length ? "recording → episode" : item.kind;
  const link = element("a", { href: path, class: "clipped item_name", title: item.id }, item.id);
  return element("td", { class: "item_name_cell" }, link, under(item.origin === "recorded" ? kind : `${kind}, ${item.origin}`));
}

export function operatorCell(item) {
  return element("td", {}, element("span", { class: "clipped" }, item.operator ?? "–"), under(item.origin === "recorded" ? CONSENT.get(item.consent) : null));
}

export function stationCell(item) {
  return element("td", {}, element("span", { class: "clipped" }, item.station ?? "–"), under(item.domain));
}

export function outcomeCell(item) {
  return element("td", { "data-outcome": String(item.success) }, OUTCOMES.get(item.success));
}

export function lengthCell(item) {
  return element("td", { class: "number" }, length(item.duration_s));
}

export function qualityCell(item) {
  const words = QUALITY.map(([name, text]) => (name in item.figures ? text(item.figures[name]) : null)).filter((text) => text);
  const findings = item.findings.slice(0, MAX_FINDINGS).map((finding) => under(finding.message, "finding"));
  const more = item.findings.length - MAX_FINDINGS;
  return element("td", { class: "quality" }, ...(words.length ? words.slice(0, 3).map((text) => element("span", { class: "figure" }, text)) : ["–"]), ...findings, under(more > 0 ? `and ${more} more` : ""));
}

export function stageCell(stage) {
  const badge = stage.label ? levelBadge(stage.level, stage.label) : null;
  const steps = stage.done === null ? null : element("span", { class: "steps", title: STEPS.map((step, index) => `${step}${index < stage.done ? " ✓" : ""}`).join(", ") },
    ...STEPS.map((_, index) => element("span", { class: index < stage.done ? "done" : "open" })));
  const share = stage.share === undefined ? null : element("progress", { value: stage.share, max: 1, "aria-label": stage.label });
  const detail = under(stage.detail, "why clipped");
  if (detail) detail.title = stage.detail;
  return element("td", { class: "stage" }, steps, badge, share, detail);
}
