// Pieces of the study pages: progress, rates with their intervals, figures of agreement.

import { element, levelBadge } from "./dom.js";

const MISSING = "–";

function stateOf(study) {
  if (study.problem) return { level: "ERROR", word: "unreadable" };
  if (study.is_running) return { level: "OK", word: "running" };
  if (study.num_done >= study.num_rollouts) return { level: "OK", word: "complete" };
  return { level: "STALE", word: "incomplete" };
}

export function stateBadge(study) {
  const { level, word } = stateOf(study);
  return levelBadge(level, word);
}

export function progress(study) {
  const bar = element("progress", { max: study.num_rollouts, value: study.num_done, "aria-label": "finished rollouts" });
  return element("span", { class: "progress" }, bar, `${study.num_done} of ${study.num_rollouts}`);
}

export function figure(value, digits = 2) {
  return value === null || value === undefined ? MISSING : value.toFixed(digits);
}

export function interval(pair, digits = 2) {
  return pair ? `[${pair[0].toFixed(digits)}, ${pair[1].toFixed(digits)}]` : "no interval";
}

// A rate from 0 to 1 as a dot on the line of its interval.
export function rateBar(rate, pair) {
  const line = element("span", { class: "line" });
  const dot = element("span", { class: "dot" });
  line.style.left = `${100 * pair[0]}%`;
  line.style.width = `${100 * (pair[1] - pair[0])}%`;
  dot.style.left = `${100 * rate}%`;
  return element("span", { class: "rate_bar", "aria-hidden": "true" }, line, dot);
}

export function why(text) {
  return text ? element("span", { class: "why" }, text) : null;
}

// What an operator has to know about a rate before using it.
export function cautions(rate) {
  const found = [];
  const total = rate.num_finished + rate.num_failed + rate.num_missing;
  if (rate.num_unreliable) found.push(`${rate.num_unreliable} of ${rate.num_finished} cannot tell: ${rate.reasons.join("; ")}`);
  if (!rate.is_comparable) found.push("not comparable: too few rollouts are decided");
  if (rate.num_failed) found.push(`${rate.num_failed} of ${total} failed to run and are not counted`);
  if (rate.num_missing) found.push(`${rate.num_missing} of ${total} have no result yet`);
  return found;
}
