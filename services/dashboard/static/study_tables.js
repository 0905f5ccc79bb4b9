// Tables of one study: rates by policy, task and world, agreement, and rollouts.

import { element, levelBadge } from "./dom.js";
import { pagePath } from "./session.js";
import { cautions, figure, interval, rateBar, why } from "./study_parts.js";

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
  const cell = element("td", { class: "rate_cell", "data-world": rate.world });
  if (rate.rate === null) {
    cell.append("–", ...cautions(rate).map(why));
    return cell;
  }
  const button = element("button", { type: "button", class: "cell_link", title: "Show these rollouts" },
    element("strong", {}, figure(rate.rate)), " ", element("span", { class: "quiet" }, interval(rate.interval)),
    rateBar(rate.rate, rate.interval));
  button.addEventListener("click", () => open(rate));
  cell.append(button);
  for (const text of cautions(rate)) cell.append(element("span", { class: "caution" }, text));
  if (rate.num_disagreements) cell.append(why(`${rate.num_disagreements} of ${rate.num_finished} differ from the real outcome`));
  return cell;
}

function figureCell(one, name, caution = "") {
  return element("td", { class: "number", "data-figure": name },
    element("strong", {}, figure(one.figures[name])), " ",
    element("span", { class: "quiet" }, one.figures[name] === null ? one.undefined : interval(one.intervals[name])),
    caution ? element("span", { class: "caution" }, caution) : null);
}

export function agreementRow(one) {
  const comments = one.comments.length ? element("details", {}, element("summary", {}, "What this shows"),
    element("ul", {}, ...one.comments.map((text) => element("li", {}, text)))) : null;
  return element("tr", { "data-world": one.world, "data-task": one.task },
    element("td", { class: "name" }, one.world),
    element("td", {}, one.task || "all tasks together"),
    figureCell(one, "pearson", one.is_vague ? "too wide to tell a faithful world from a poor one" : ""), figureCell(one, "mean_absolute_error"), figureCell(one, "mmrv"), figureCell(one, "bias"),
    element("td", { class: "number" }, one.chance === null ? "–" : one.chance < 0.001 ? "< 0.001" : one.chance.toFixed(3)),
    element("td", { class: "number" }, `${one.num_policies} × ${one.num_starts}`),
    element("td", { class: "free" }, comments));
}

function outcome(success) {
  if (success === null || success === undefined) return "–";
  return success ? "success" : "failure";
}

// `playable` holds the ids of episodes that the dashboard's store has; others get no link.
export function rolloutRow(rollout, playable) {
  const play = (id, label) => (id && playable.has(id)
    ? element("a", { href: pagePath(`/episodes/episode/${encodeURIComponent(id)}`) }, label) : null);
  const links = [play(rollout.episode_id, rollout.world === "real" ? "Play" : `Play ${rollout.world}`),
    rollout.world === "real" ? null : play(rollout.real_episode_id, "Play real"),
    rollout.real_episode_id && playable.has(rollout.real_episode_id)
      ? element("a", { href: pagePath(`/rollouts?replay=${encodeURIComponent(rollout.real_episode_id)}`), title: "Replay in the twin and in the world model, side by side" }, "Compare") : null].filter(Boolean);
  return element("tr", {},
    element("td", {}, rollout.disagrees ? levelBadge("WARN", "differs") : ""),
    element("td", {}, rollout.world), element("td", {}, rollout.task), element("td", {}, rollout.policy),
    element("td", { class: "number" }, String(rollout.seed), why(rollout.repeat ? `repeat ${rollout.repeat}` : "")),
    element("td", {}, rollout.error ? "failed to run" : outcome(rollout.success), why(rollout.error)),
    element("td", {}, outcome(rollout.real_success)),
    element("td", { class: "number" }, figure(rollout.probability)),
    element("td", { class: "free" }, rollout.unreliable ? element("span", { class: "caution" }, rollout.unreliable) : ""),
    element("td", { class: "play" }, ...(links.length ? links : ["–"])));
}
