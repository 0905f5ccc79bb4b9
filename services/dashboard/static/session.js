// Requests of the page; without a session it is loaded anew, which shows the sign-in.

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
  const answer = await fetch(stationPath(path), options);
  if (answer.status === 401) location.reload();
  return answer;
}

// An answer that is no refusal; refusals become errors with their reason.
export async function checked(answer) {
  if (answer.ok) return answer;
  const problem = await answer.json().catch(() => ({}));
  throw new Error(problem.detail ?? `The dashboard answered ${answer.status}.`, { cause: answer.status });
}
