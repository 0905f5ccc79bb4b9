// Requests of the rating pages with the key that was entered, and what is said when they fail.

export const at = (id) => document.getElementById(id);

export async function request(path, { key, body } = {}) {
  const headers = { ...(key && { authorization: `Bearer ${key}` }), ...(body && { "content-type": "application/json" }) };
  const answer = await fetch(`/v1/rating/${path}`, { method: body ? "POST" : "GET", headers, body: body && JSON.stringify(body) });
  if (answer.ok) return answer;
  const problem = await answer.json().catch(() => ({}));
  throw new Error(problem.detail ?? `${answer.status} ${answer.statusText}`);
}

export async function attempt(work) {
  at("problem").textContent = "";
  await work().catch((error) => (at("problem").textContent = error.message));
}
