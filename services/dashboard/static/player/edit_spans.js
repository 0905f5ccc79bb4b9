// Selections and edits as the store and the command line name them: steps, seconds, shell words.

import { quote } from "../command.js";
import { secondsText } from "./times.js";

// Steps of an episode at or after the start of a span and before its end: [first, stop]. The last step
// belongs to a span that ends on it, since nothing can be selected after it.
export function stepsOf([from_ns, to_ns], { num_steps, model_rate_hz }) {
  const step = (t_ns) => Math.min(Math.max(Math.ceil((t_ns * model_rate_hz) / 1e9 - 1e-4), 0), num_steps);
  const isWhole = (to_ns * model_rate_hz) / 1e9 > num_steps - 1 - 1e-4;
  return [step(from_ns), isWhole ? num_steps : step(to_ns)];
}

function command(name, kind, ids, options) {
  const words = Object.entries(options).flatMap(([key, value]) => (value === undefined || value === null || value === false || value === "" ? [] : value === true ? [`--${key}`] : [`--${key}`, ...[value].flat().map((one) => quote(String(one)))]));
  return ["dextouch store", name, ...ids, ...(kind === "recording" ? ["--kind recording"] : []), ...words].join(" ");
}

export function trimCommand(id, [first, stop], { outcome, keep }) {
  return command("trim", "episode", [id], { steps: [first, stop], outcome, keep });
}

export function relabelCommand({ kind, id }, { task, instruction, operator, outcome, keep }) {
  return command("relabel", kind, [id], { task, instruction, operator, outcome, keep });
}

export function spanText([from_ns, to_ns]) {
  const ms = (t_ns) => secondsText(Math.round(t_ns / 1e6) * 1e6);
  return from_ns === to_ns ? `${ms(from_ns)} s` : `${ms(from_ns)} – ${ms(to_ns)} s`;
}
