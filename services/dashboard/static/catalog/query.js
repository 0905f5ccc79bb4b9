// What the list shows ↔ the page's address, and the request to the store. No DOM here.

export const PAGE_ROWS = 50;
const VIEWS = ["take", "recording", "episode", "trash"];
export const FILTERS = ["text", "task", "operator", "station", "domain", "outcome", "origin", "review", "from", "to"];
const SORTS = ["time", "task", "id", "operator", "station", "duration", "findings"];
// `station` in an address is the page's own, also on this page.
const ADDRESS_NAMES = { station: "of_station" };
const addressName = (name) => ADDRESS_NAMES[name] ?? name;
const DAY = /^\d{4}-\d{2}-\d{2}$/;

// Unknown values fall back to the defaults: an address may come from an older page, or from anybody.
export function readQuery(search) {
  const given = new URLSearchParams(search);
  const pick = (name, allowed) => (allowed.includes(given.get(name)) ? given.get(name) : allowed[0]);
  const page = Number.parseInt(given.get("page") ?? "1", 10);
  const filters = {};
  for (const name of FILTERS) {
    const value = given.get(addressName(name)) ?? "";
    filters[name] = ["from", "to"].includes(name) && !DAY.test(value) ? "" : value.slice(0, 200);
  }
  return {
    view: pick("view", VIEWS), sort: pick("sort", SORTS), descending: given.get("order") !== "up",
    page: Number.isSafeInteger(page) && page > 0 ? page : 1, filters,
  };
}

export function writeQuery({ view, sort, descending, page, filters }) {
  const written = new URLSearchParams();
  if (view !== VIEWS[0]) written.set("view", view);
  for (const name of FILTERS) if (filters[name]) written.set(addressName(name), filters[name]);
  if (sort !== SORTS[0]) written.set("sort", sort);
  if (!descending) written.set("order", "up");
  if (page > 1) written.set("page", String(page));
  const text = written.toString();
  return text ? `?${text}` : "";
}

export function isFiltered({ filters }) {
  return FILTERS.some((name) => filters[name]);
}

// Midnight of a day here, days later, with its zone.
export function midnight(day, daysLater = 0) {
  const [year, month, date] = day.split("-").map(Number);
  return new Date(year, month - 1, date + daysLater).toISOString();
}

export function storeQuery({ view, sort, descending, page, filters }) {
  const query = new URLSearchParams({
    kind: view, sort, descending: String(descending), limit: String(PAGE_ROWS), offset: String((page - 1) * PAGE_ROWS),
  });
  for (const name of FILTERS) if (filters[name] && !["from", "to"].includes(name)) query.set(name, filters[name]);
  if (filters.from) query.set("created_after", midnight(filters.from));
  if (filters.to) query.set("created_before", midnight(filters.to, 1));
  return query.toString();
}

export function pageWords(page, num_matching) {
  if (num_matching === 0) return "none";
  const first = (page - 1) * PAGE_ROWS + 1;
  const last = Math.min(page * PAGE_ROWS, num_matching);
  return first > num_matching ? `none on this page, ${num_matching} in all` : `${first} to ${last} of ${num_matching}`;
}
