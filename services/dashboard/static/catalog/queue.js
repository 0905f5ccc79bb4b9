// What the review queue lists, and in which order. No DOM here.

import { plural } from "../format.js";

const MAX_FAILED = 200;

// The last job of each recording whose alignment failed, newest first.
export function failedRecordings(alignments) {
  const newest = alignments.filter((job) => job.state === "failed").reverse().slice(0, MAX_FAILED);
  return new Map(newest.map((job) => [job.recording_id, job]));
}

// Recordings that could not be aligned first, then what the store flagged, in its order.
export function queueOf(flagged, { jobs, items }) {
  const key = (item) => `${item.kind}/${item.id}`;
  const failed = items.filter((item) => !item.episodes.length).map((item) => ({ key: key(item), item, job: jobs.get(item.id) }));
  const known = new Set(failed.map((one) => one.key));
  return [...failed, ...flagged.map((item) => ({ key: key(item), item })).filter((one) => !known.has(one.key))];
}

// A verdict on a take is one on all its episodes, or on its recording while it has none.
export function reviewedItems({ kind, id, episodes }) {
  return kind === "recording" && episodes.length ? episodes.map((one) => ({ kind: "episode", id: one })) : [{ kind, id }];
}

export function fewWords(groups, { task, origin }) {
  const few = groups.filter((one) => !one.is_compared && (!task || one.task === task) && (!origin || one.origin === origin));
  if (!few.length) return "";
  const names = few.slice(0, 8).map((one) => `${one.task} (${plural(one.num_items, `${one.domain} ${one.kind}`)})`);
  const more = few.length > 8 ? `, and ${few.length - 8} more` : "";
  return `Too few to be compared, at least ${few[0].min_items} are needed: ${names.join(", ")}${more}.`;
}
