// A stored item as an operator reads it: how far it is, the cells of its row, and its lineage.

import { cell, element, levelBadge, why } from "../dom.js";
import { date, number } from "../format.js";
import { get, getIfServed, pagePath } from "../requests.js";

const STEPS = ["saved", "uploaded", "aligned", "checked"];
const VERDICTS = { accepted: { label: "Accepted", level: "OK" }, rejected: { label: "Rejected", level: "ERROR" } };
const JOBS = {
  waiting: () => ({ label: "Waiting to be aligned", level: "STALE" }),
  running: (job) => ({ label: `Aligning, ${Math.round(100 * job.progress)} %`, level: "STALE", share: job.progress }),
  failed: (job) => ({ label: "Alignment failed", level: "ERROR", detail: reasonOf(job) }),
  cancelled: () => ({ label: "Alignment cancelled", level: "WARN" }),
};

// Why a job failed; the recording's name is in the row already.
export function reasonOf({ problem }) {
  return (problem?.detail ?? "no reason given").replace(/^recording '[^']*': /, "");
}

// `done` counts the steps that are behind a take; an item that is no recording of a station has no steps.
export function stageOf({ item, upload, job }) {
  const uploading = upload?.refused ? { label: "Refused by the store", level: "ERROR" } : { label: "Uploading", level: "STALE" };
  if (upload) return { done: 1, ...uploading, detail: upload.error ?? "" };
  const isAligned = item.kind === "episode" || item.episodes.length > 0;
  const isTake = item.kind === "recording" || item.recordings.length > 0;
  const done = isTake ? (isAligned ? 4 : 2) : null;
  if (item.review) return { done, ...VERDICTS[item.review.verdict], detail: item.review.reason ?? "" };
  if (!isAligned && job && JOBS[job.state]) return { done, ...JOBS[job.state](job) };
  // Seen before anything else: such a take is never "Checked" without a person.
  if (!item.complete) return { done, label: "Incomplete", level: "WARN", detail: item.incomplete_cause };
  if (!isAligned) return { done, label: "Not aligned", level: "STALE" };
  if (item.origin !== "recorded" && !item.findings.length) return { done, label: "", level: "OK" };
  return { done, ...(item.findings.length ? { label: "To review", level: "WARN" } : { label: "Checked", level: "OK" }) };
}

// Rows of one page: takes on their way to the store first, then what the store lists. Rows of one take
// have one key, so that it stays the same row while it moves on.
export function rowsOf({ items, uploads, pending, jobs, isFirstPage }) {
  const stored = new Set(items.map((item) => `${item.kind}/${item.id}`));
  const rows = items.map((item) => ({ key: `${item.kind}/${item.id}`, item, job: jobs.get(item.id) }));
  if (!isFirstPage) return rows;
  const waiting = uploads.filter((upload) => !upload.uploaded).map((upload) => {
    const id = upload.stored_as ?? upload.recording_id;
    const known = pending.find((one) => one.recording_id === id);
    return { key: `recording/${id}`, id, upload, task: known?.task ?? null, station: known?.station ?? null };
  });
  return [...waiting.filter((row) => !stored.has(row.key)), ...rows];
}

// What is moved when a row is deleted: a take with all its episodes.
export function itemsOf(row, view) {
  const { kind, id, episodes } = row.item;
  const derived = view === "take" && kind === "recording" ? episodes.map((one) => ({ kind: "episode", id: one })) : [];
  return [{ kind, id }, ...derived];
}

// What is played and reviewed in a row: the aligned episode of a take, else the item itself.
export function subjectOf(item) {
  const { kind, id } = item.aligned ?? item;
  return { kind, id };
}

export function playerPath(item) {
  const { kind, id } = subjectOf(item);
  return `/episodes/${kind}/${encodeURIComponent(id)}`;
}

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

const clipped = (text) => element("span", { class: "clipped" }, text);

export function pickCell(name) {
  return cell(element("input", { type: "checkbox", tabindex: -1, "aria-label": `select ${name}` }), "pick");
}

export function timeCell(at) {
  return cell([date(at, "day"), why(at ? date(at, "time") : "")]);
}

export function taskCell({ task, instruction }) {
  return cell([element("strong", { class: "clipped" }, task), element("span", { class: "why clipped", title: instruction }, instruction)], "task");
}

export function nameCell(item, path) {
  const kind = item.kind === "recording" && item.episodes.length ? "recording → episode" : item.kind;
  const link = element("a", { href: path, class: "clipped item_name", title: item.id }, item.id);
  return cell([link, why(item.origin === "recorded" ? kind : `${kind}, ${item.origin}`)], "item_name_cell");
}

export function operatorCell(item) {
  return cell([clipped(item.operator ?? "–"), why(item.origin === "recorded" ? CONSENT.get(item.consent) : null)]);
}

export const stationCell = (item) => cell([clipped(item.station ?? "–"), why(item.domain)]);

export const outcomeCell = (item) => cell(OUTCOMES.get(item.success), null, { "data-outcome": String(item.success) });

export function lengthCell({ duration_s }) {
  return cell(duration_s < 60 ? `${number(duration_s, 1)} s` : `${Math.floor(duration_s / 60)}:${String(Math.floor(duration_s % 60)).padStart(2, "0")} min`, "number");
}

export function qualityCell(item) {
  const words = QUALITY.map(([name, text]) => (name in item.figures ? text(item.figures[name]) : null)).filter((text) => text);
  const findings = item.findings.slice(0, MAX_FINDINGS).map((finding) => why(finding.message, "finding"));
  const more = item.findings.length - MAX_FINDINGS;
  return cell([...(words.length ? words.slice(0, 3).map((text) => why(text, "figure")) : ["–"]), ...findings, why(more > 0 ? `and ${more} more` : "")], "quality");
}

export function stageCell(stage) {
  const badge = stage.label && levelBadge(stage.level, stage.label);
  const steps = stage.done === null ? null : element("span", { class: "steps", title: STEPS.map((step, index) => `${step}${index < stage.done ? " ✓" : ""}`).join(", ") },
    ...STEPS.map((_, index) => element("span", { class: index < stage.done ? "done" : "open" })));
  const share = stage.share === undefined ? null : element("progress", { value: stage.share, max: 1, "aria-label": stage.label });
  const detail = stage.detail ? element("span", { class: "why clipped", title: stage.detail }, stage.detail) : null;
  return cell([steps, badge, share, detail], "stage");
}

const RELATIONS = [["source", "Made from"], ["self", "This item"], ["product", "Made from this item"]];
const PLAYED = ["recording", "episode"];

// A line of an item's lineage.
export function nodeItem(node, relation = "") {
  const name = node.is_stored && PLAYED.includes(node.kind)
    ? element("a", { href: pagePath(`/episodes/${node.kind}/${encodeURIComponent(node.id)}`) }, node.id)
    : element("strong", {}, node.id);
  const known = node.is_stored || !PLAYED.includes(node.kind) ? node.summary : "not in this store: deleted, or elsewhere";
  return element("li", {}, element("span", { class: "quiet" }, `${relation} ${node.kind} `.trimStart()), name, why(known));
}

function jobItem(job) {
  const share = job.state === "running" ? `, ${Math.round(100 * job.progress)} %` : "";
  return element("li", {}, element("span", { class: "quiet" }, `${job.state}${share}`), element("strong", {}, job.alignment_id),
    why(job.problem?.detail ?? (job.attempts > 1 ? `${job.attempts} attempts` : "")));
}

function part(title, items) {
  return items.length ? [element("h3", {}, title), element("ul", { class: "lineage" }, ...items)] : [];
}

export async function showLineage(dialog, { kind, id }) {
  const body = dialog.querySelector("[data-body]");
  dialog.querySelector("[data-title]").textContent = id;
  body.replaceChildren(element("p", { class: "note" }, "loading"));
  if (!dialog.open) dialog.showModal();
  try {
    const { nodes } = await get(`/v1/episode_store/catalog/lineage/${kind}/${encodeURIComponent(id)}`);
    const recordings = nodes.filter((node) => node.kind === "recording").map((node) => ["recording_id", node.id]);
    const none = { alignments: [] };
    const { alignments } = recordings.length ? await getIfServed(`/v1/alignment/alignments?${new URLSearchParams(recordings)}`, none) : none;
    body.replaceChildren(
      ...RELATIONS.flatMap(([relation, title]) => part(title, nodes.filter((node) => node.relation === relation).map(nodeItem))),
      ...part("Alignments", alignments.map(jobItem)));
  } catch (error) {
    body.replaceChildren(element("p", { class: "note", "data-level": "ERROR", role: "alert" }, error.message));
  }
}
