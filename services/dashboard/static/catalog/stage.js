// Where a take is on its way: saved → uploaded → aligned → checked. No DOM here.

export const STEPS = ["saved", "uploaded", "aligned", "checked"];
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
  if (upload) {
    return upload.refused
      ? { done: 1, label: "Refused by the store", level: "ERROR", detail: upload.error ?? "" }
      : { done: 1, label: "Uploading", level: "STALE", detail: upload.error ?? "" };
  }
  const isAligned = item.kind === "episode" || item.episodes.length > 0;
  const isTake = item.kind === "recording" || item.recordings.length > 0;
  const done = isTake ? (isAligned ? 4 : 2) : null;
  const reason = item.review?.reason ?? "";
  if (item.review) return { done, ...VERDICTS[item.review.verdict], detail: reason };
  if (!isAligned && job && JOBS[job.state]) return { done, ...JOBS[job.state](job) };
  // Seen before anything else: such a take is never "Checked" without a person.
  if (!item.complete) return { done, label: "Incomplete", level: "WARN", detail: item.incomplete_cause };
  if (!isAligned) return { done, label: "Not aligned", level: "STALE" };
  if (item.origin !== "recorded" && !item.findings.length) return { done, label: "", level: "OK" };
  return item.findings.length
    ? { done, label: "To review", level: "WARN" }
    : { done, label: "Checked", level: "OK" };
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
