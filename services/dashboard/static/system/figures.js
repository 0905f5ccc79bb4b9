// Figures of the system page as words, without DOM.

import { bytes, number } from "../format.js";

const MISSING = "–";
// A slower change is not the recorder's.
const STILL_BYTES_PER_S = 1000;

// "measuring" while the disk has been watched for too short a time.
export function filling(rate) {
  if (rate === null) return "measuring";
  if (Math.abs(rate) < STILL_BYTES_PER_S) return "no change";
  return rate > 0 ? `${bytes(rate)}/s` : `${bytes(-rate)}/s freed`;
}

// How long acknowledged takes stay in a spool.
export function retention({ keep_s, keep_bytes }) {
  if (keep_s === 0 || keep_bytes === 0) return "removed once the store has them";
  const days = keep_s / 86_400;
  const most = keep_bytes === null ? "" : `, at most ${bytes(keep_bytes)}`;
  return `kept for ${Number(days.toFixed(1))} ${days === 1 ? "day" : "days"}${most}`;
}

export function latency(value_s) {
  return value_s === null ? MISSING : number(1000 * value_s, value_s < 0.01 ? 1 : 0, "ms");
}

export function cpu(ratio) {
  return ratio === null ? MISSING : number(100 * ratio, 0, "%");
}

export function result(status) {
  if (status < 400) return "done";
  return `${status < 500 ? "refused" : "failed"} (${status})`;
}

// The newest enrolment of each station, by name.
export function newestOf(enrolments) {
  const newest = new Map();
  for (const one of enrolments) {
    const known = newest.get(one.station);
    if (!known || Date.parse(one.requested_at) > Date.parse(known.requested_at)) newest.set(one.station, one);
  }
  return [...newest.values()].sort((a, b) => (a.station < b.station ? -1 : 1));
}

// Since when an enrolment is in its state.
export function since({ revoked_at, enrolled_at, requested_at }) {
  return revoked_at ?? enrolled_at ?? requested_at;
}
