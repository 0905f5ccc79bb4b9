// Open rollouts and those that ended last → rows of the table, and the words for their state, uncertainty and outcome.

import { button, cell, element, levelBadge, showChildren, why, wideRow } from "./dom.js";
import { age } from "./format.js";

const IDLE_S = 30;
// What a service without keys calls everybody.
const WITHOUT_KEYS = "loopback";
const KINDS = { twin: "physics twin", model: "imagined", baseline: "baseline", robot: "robot" };

export function stateOf(rollout) {
  if (rollout.isOver) return { level: "STALE", word: "over" };
  if (rollout.ended) return { level: "ERROR", word: "ended" };
  if (rollout.rollout_doubt?.reason) return { level: "WARN", word: "unreliable" };
  if (rollout.idle_s > IDLE_S) return { level: "STALE", word: "waiting" };
  return { level: "OK", word: "running" };
}

// Uncertainty of the newest chunk in words; `reason` is what to read beside a number that cannot be trusted.
// Once a chunk was unreliable, the rest of the rollout is unreliable, too.
export function uncertaintyOf(rollout) {
  const { doubt: uncertainty, kind, rollout_doubt: whole } = rollout;
  if (uncertainty) {
    const estimate = uncertainty.success_probability ?? null;
    const success = estimate === null ? "" : `, success ${(100 * estimate).toFixed(0)} % by its own estimate`;
    const figures = `disagreement ${uncertainty.disagreement.toPrecision(2)}, distance ${uncertainty.distance.toPrecision(2)}${success}`;
    const earlier = whole?.reason ? `unreliable since step ${whole.step}: ${whole.reason}` : "";
    return { text: uncertainty.outside ? `above its bound: ${figures}` : `within its bound: ${figures}`, reason: uncertainty.reason ?? earlier };
  }
  if (kind === "model") return { text: "not reported", reason: rollout.next_chunk === 0 ? "" : "This model has no uncertainty figure: nothing says how reliable these steps are." };
  return { text: "–", reason: "" };
}

// What is known of the outcome so far: from the world itself, or by the estimate of one that imagines.
export function outcomeOf({ success, rollout_doubt: whole }) {
  if (success !== null && success !== undefined) return success ? "success" : "no success";
  const estimate = whole?.success_probability ?? null;
  return estimate === null ? "–" : `success with ${(100 * estimate).toFixed(0)} %, imagined`;
}

function rolloutRow(rollout, isWatched, watch) {
  const state = stateOf(rollout);
  const uncertainty = uncertaintyOf(rollout);
  return element("tr", { "data-level": state.level === "OK" ? null : state.level, "data-watch": rollout.isOver ? null : rollout.watch_id,
    "data-over": rollout.isOver ? rollout.watch_id : null, "data-key": `${rollout.watch_id}${Boolean(rollout.isOver)}` },
    cell([levelBadge(state.level, state.word), why(rollout.ended)]), cell([rollout.world, why(KINDS[rollout.kind] ?? rollout.service)], "name"),
    cell([rollout.client || "not named", why(rollout.key && rollout.key !== WITHOUT_KEYS ? `key ${rollout.key}` : "")]),
    cell([rollout.task, why(rollout.instruction)], "task"), cell(String(rollout.next_chunk), "number"),
    cell([String(rollout.last_step), why(rollout.model_rate_hz ? `${(rollout.last_step / rollout.model_rate_hz).toFixed(1)} s` : "")], "number"),
    cell(age(rollout.age_s), "number"), cell(age(rollout.idle_s), "number"), cell([uncertainty.text, why(uncertainty.reason)], "uncertainty"),
    cell([outcomeOf(rollout), why(rollout.isOver && rollout.rollout_doubt?.reason ? "unreliable" : "")], "outcome"),
    cell(rollout.isOver ? "" : button(isWatched ? "Watching" : "Watch", () => watch(rollout), { "aria-pressed": isWatched })));
}

export function showRollouts(body, { rollouts, over = [] }, watched, watch) {
  const rows = [...rollouts, ...over.map((one) => ({ ...one, isOver: true }))].map((one) => rolloutRow(one, one.watch_id === watched, watch));
  const empty = wideRow(11, "No open rollouts. A policy that is evaluated in one of the worlds appears here; the last ten stay with their outcome.");
  showChildren(body, rollouts.length ? rows : [empty, ...rows]);
}
