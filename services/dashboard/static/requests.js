// Requests of the pages, whose refusals become errors with their reason; without a session a page is loaded anew, which shows the sign-in.

import { element } from "./dom.js";

// What belongs to one station: the page's own, of several the one that its address names.
const OF_STATION = /^\/v1\/(acquisition|recorder|uploads|cameras|overview|live)\b/;

export function stationPath(path, station = new URLSearchParams(location.search).get("station")) {
  if (station === null || !OF_STATION.test(path)) return path;
  return `${path}${path.includes("?") ? "&" : "?"}station=${encodeURIComponent(station)}`;
}

// Address of a page of the dashboard that stays with this page's station.
export function pagePath(path) {
  const station = new URLSearchParams(location.search).get("station");
  const url = new URL(path, location.href);
  if (station !== null) url.searchParams.set("station", station);
  return `${url.pathname}${url.search}${url.hash}`;
}

export async function ask(path, options) {
  const answer = await fetch(stationPath(path), options).catch((error) => {
    throw new Error(`The dashboard did not answer: ${error.message}`);
  });
  if (answer.status === 401) location.reload();
  return answer;
}

// An answer that is no refusal; refusals become errors with their reason.
export async function checked(answer) {
  if (answer.ok) return answer;
  const problem = await answer.json().catch(() => ({}));
  throw new Error(problem.detail ?? `The dashboard answered ${answer.status}.`, { cause: answer.status });
}

export async function get(path) {
  return (await checked(await ask(path))).json();
}

export async function send(path, body, options = {}) {
  const headers = { "content-type": "application/json" };
  return checked(await ask(path, { method: "POST", headers, body: JSON.stringify(body), ...options }));
}

export async function post(path, body) {
  const answer = await send(path, body);
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
