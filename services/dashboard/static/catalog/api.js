// Requests to the store and to alignment through the dashboard; refusals become errors with their reason.

import { element } from "../dom.js";
import { ask, checked } from "../session.js";

export async function get(path) {
  return (await checked(await ask(path))).json();
}

export async function post(path, body) {
  const headers = { "content-type": "application/json" };
  const answer = await checked(await ask(path, { method: "POST", headers, body: JSON.stringify(body) }));
  return answer.status === 204 ? null : answer.json();
}

// Lists of a form's filters, by name and what is chosen; that is listed even where the store does not have it.
export async function listChoices(form, chosen) {
  const values = await get("/v1/episode_store/catalog/values").catch(() => ({}));
  for (const [name, value] of Object.entries(chosen)) {
    const all = new Set([...(values[`${name}s`] ?? []), value]);
    all.delete("");
    form.elements[name].replaceChildren(element("option", { value: "" }, "all"), ...[...all].map((one) => element("option", { value: one }, one)));
    form.elements[name].value = value;
  }
}

// Services that this dashboard was started without are not asked again.
const absent = new Set();

// Of a service that may be absent or down: `missing` in its place.
export async function getIfServed(path, missing) {
  const service = path.split("/")[2];
  if (absent.has(service)) return missing;
  try {
    return await get(path);
  } catch (error) {
    if (error.cause === 404) absent.add(service);
    if ([404, 503].includes(error.cause)) return missing;
    throw error;
  }
}

// The newest alignment job of each of these recordings, by recording.
export async function newestJobs(recordings) {
  if (!recordings.length) return new Map();
  const query = new URLSearchParams([["limit", "1000"], ...recordings.map((id) => ["recording_id", id])]);
  const { alignments } = await getIfServed(`/v1/alignment/alignments?${query}`, { alignments: [] });
  return new Map(alignments.map((job) => [job.recording_id, job]));
}
