// Tables of the study pages: progress, rates by policy, task and world, agreement, and rollouts.

import { button, cell, element, levelBadge, why } from "./dom.js";
import { number } from "./format.js";
import { pagePath } from "./requests.js";

export function stateBadge(study) {
  if (study.problem) return levelBadge("ERROR", "unreadable");
  if (study.is_running) return levelBadge("OK", "running");
  return study.num_done >= study.num_rollouts ? levelBadge("OK", "complete") : levelBadge("STALE", "incomplete");
}

export function progress(value, max, label, words = `${value} of ${max}`) {
  return element("span", { class: "progress" }, element("progress", { max, value, "aria-label": label }), words);
}

export function studyProgress({ num_done, num_rollouts }) {
  return progress(num_done, num_rollouts, "finished rollouts");
}

function interval(pair) {
  return pair ? `[${pair[0].toFixed(2)}, ${pair[1].toFixed(2)}]` : "no interval";
}

// A rate from 0 to 1 as a dot on the line of its interval.
function rateBar(rate, pair) {
  const line = element("span", { class: "line" });
  const dot = element("span", { class: "dot" });
  line.style.left = `${100 * pair[0]}%`;
  line.style.width = `${100 * (pair[1] - pair[0])}%`;
  dot.style.left = `${100 * rate}%`;
  return element("span", { class: "rate_bar", "aria-hidden": "true" }, line, dot);
}

// What an operator has to know about a rate before using it.
function cautions(rate) {
  const found = [];
  const total = rate.num_finished + rate.num_failed + rate.num_missing;
  if (rate.num_unreliable) found.push(`${rate.num_unreliable} of ${rate.num_finished} cannot tell: ${rate.reasons.join("; ")}`);
  if (!rate.is_comparable) found.push("not comparable: too few rollouts are decided");
  if (rate.num_failed) found.push(`${rate.num_failed} of ${total} failed to run and are not counted`);
  if (rate.num_missing) found.push(`${rate.num_missing} of ${total} have no result yet`);
  return found;
}

// One row per task and policy, with its rates by world.
export function rateRows(rates) {
  const rows = new Map();
  for (const rate of rates) {
    const key = JSON.stringify([rate.task, rate.policy]);
    if (!rows.has(key)) rows.set(key, { task: rate.task, policy: rate.policy, worlds: {} });
    rows.get(key).worlds[rate.world] = rate;
  }
  return [...rows.values()];
}

export function rateCell(rate, open) {
  const attributes = ["rate_cell", { "data-world": rate.world }];
  if (rate.rate === null) {
    return cell(["–", ...cautions(rate).map((text) => why(text))], ...attributes);
  }
  const figures = [element("strong", {}, number(rate.rate, 2)), " ", element("span", { class: "quiet" }, interval(rate.interval)), rateBar(rate.rate, rate.interval)];
  return cell([button(figures, () => open(rate), { class: "cell_link", title: "Show these rollouts" }), ...cautions(rate).map((text) => why(text, "caution")),
    why(rate.num_disagreements && `from ${rate.num_disagreements} ${rate.num_disagreements === 1 ? "start" : "starts"} the outcome differs from the real one`)], ...attributes);
}

function figureCell(one, name, caution = "") {
  const range = one.figures[name] === null ? one.undefined : interval(one.intervals[name]);
  return cell([element("strong", {}, number(one.figures[name], 2)), " ", element("span", { class: "quiet" }, range), why(caution, "caution")], "number", { "data-figure": name });
}

// Figures of agreement that have a column: their keys in a study's figures, and their titles.
export const FIGURES = [["pearson", "Pearson"], ["kendall", "Kendall"], ["mean_absolute_error", "Mean absolute error"], ["mmrv", "MMRV"], ["bias", "Bias"]];
export function agreementRow(one) {
  const comments = one.comments.length ? element("details", {}, element("summary", {}, "What this shows"),
    element("ul", {}, ...one.comments.map((text) => element("li", {}, text)))) : null;
  return element("tr", { "data-world": one.world, "data-task": one.task },
    cell(one.world, "name"), cell(one.task || "all tasks together"),
    ...FIGURES.map(([name]) => figureCell(one, name, name === "pearson" && one.is_vague ? "too wide to tell a faithful world from a poor one" : "")),
    cell(one.chance === null ? "–" : one.chance < 0.001 ? "< 0.001" : one.chance.toFixed(3), "number"),
    cell(`${one.num_policies} × ${one.num_starts}`, "number"), cell(comments, "free"));
}

const OUTCOMES = new Map([[true, "success"], [false, "failure"]]);
const outcome = (success) => OUTCOMES.get(success) ?? "–";

// `playable` holds the ids of episodes that the dashboard's store has; others get no link.
export function rolloutRow(rollout, playable) {
  const play = (id, label) => (id && playable.has(id)
    ? element("a", { href: pagePath(`/episodes/episode/${encodeURIComponent(id)}`) }, label) : null);
  const links = [play(rollout.episode_id, rollout.world === "real" ? "Play" : `Play ${rollout.world}`),
    rollout.world === "real" ? null : play(rollout.real_episode_id, "Play real"),
    rollout.real_episode_id && playable.has(rollout.real_episode_id)
      ? element("a", { href: pagePath(`/rollouts?replay=${encodeURIComponent(rollout.real_episode_id)}`), title: "Replay in the twin and in the world model, side by side" }, "Compare") : null].filter(Boolean);
  return element("tr", {},
    cell(rollout.disagrees ? levelBadge("WARN", "differs") : ""), cell(rollout.world), cell(rollout.task), cell(rollout.policy),
    cell([String(rollout.seed), why(rollout.repeat && `repeat ${rollout.repeat}`)], "number"),
    cell([rollout.error ? "failed to run" : outcome(rollout.success), why(rollout.error)]), cell(outcome(rollout.real_success)),
    cell(number(rollout.probability, 2), "number"), cell(why(rollout.unreliable, "caution"), "free"), cell(links.length ? links : "–", "play"));
}
