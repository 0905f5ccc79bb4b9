// Hours of recorded episodes by task, operator, station and day, by what was said of them in review.

import { date } from "../dates.js";
import { element, find, repeat, setText } from "../dom.js";
import { number, plural } from "../format.js";
import { pagePath } from "../session.js";
import { get, listChoices } from "./api.js";
import { bars, counted, withGoals } from "./hours_rows.js";
import { readQuery, storeQuery } from "./query.js";

const REFRESH_MS = 30000;
const FIELDS = ["task", "operator", "station", "day"];
const NAMES = ["origin", "domain", "task", "operator", "from", "to"];
const form = find("filters");
const goals = JSON.parse(find("hours").dataset.goals);
let asked = 0;

function hours(value_h) {
  if (value_h === 0) return "–";
  return value_h < 1 ? number(60 * value_h, 1, "min") : number(value_h, value_h < 10 ? 2 : 1, "h");
}

function bar({ parts, goal }) {
  const node = element("div", { class: "bar_frame" });
  for (const { part, share } of parts) {
    const piece = element("span", { class: "bar_part", "data-part": part });
    piece.style.width = `${100 * share}%`;
    node.append(piece);
  }
  if (goal !== null) {
    const mark = element("span", { class: "goal_mark" });
    mark.style.left = `${100 * goal}%`;
    node.append(mark);
  }
  return node;
}

function row(field, data, drawn) {
  const cell = (text, name = "number") => element("td", { class: name }, text);
  const goal = data.goal_h === null ? "" : `${Math.round(100 * drawn.reached)} % of ${hours(data.goal_h)}`;
  const label = data.value === null ? "not known" : field === "day" ? date(`${data.value}T00:00`, "day") : data.value;
  return element("tr", {}, element("th", { scope: "row", title: label }, element("span", { class: "clipped" }, label)), element("td", { class: "bars" }, bar(drawn)),
    cell(hours(data.accepted_h)), cell(hours(data.not_reviewed_h)), cell(hours(data.rejected_h)), cell(hours(drawn.total_h)),
    cell(String(data.num_episodes)), cell(goal, "number goal"));
}

// Newest days first.
function show(field, rows) {
  const listed = field === "task" ? withGoals(rows, wantedGoals()) : rows.map((one) => ({ ...one, goal_h: null }));
  if (field === "day") listed.reverse();
  const drawn = bars(listed);
  find(`${field}_rows`).replaceChildren(...listed.map((one, index) => row(field, one, drawn[index])));
  find(`${field}_empty`).hidden = listed.length > 0;
  return listed;
}

function wantedGoals() {
  const task = form.elements.task.value;
  return task ? Object.fromEntries(Object.entries(goals).filter(([name]) => name === task)) : goals;
}

function address() {
  const given = new URLSearchParams();
  for (const name of NAMES) if (form.elements[name].value) given.set(name, form.elements[name].value);
  // Everything but recordings is the exception: the default is not in the address.
  if (given.get("origin") === "recorded") given.delete("origin");
  else if (!given.has("origin")) given.set("origin", "any");
  return given.toString();
}

function storeFilters() {
  const filters = readQuery(`?${address()}`).filters;
  filters.origin = form.elements.origin.value;
  const asked = new URLSearchParams(storeQuery({ view: "", sort: "", descending: true, page: 1, filters }));
  for (const name of ["kind", "sort", "descending", "limit", "offset"]) asked.delete(name);
  asked.set("utc_offset_min", String(-new Date().getTimezoneOffset()));
  return asked;
}

async function refresh() {
  const number = ++asked;
  try {
    const filters = storeFilters();
    const answers = await Promise.all(FIELDS.map((field) => get(`/v1/episode_store/catalog/hours/${field}?${filters}`)));
    if (number !== asked) return;
    const shown = FIELDS.map((field, index) => show(field, answers[index].rows));
    const sum = (of) => shown[0].reduce((total, one) => total + of(one), 0);
    const kept = plural(sum((one) => one.num_episodes), "episode");
    setText(find("total"), shown[0].length ? `${hours(sum(counted))} in ${kept}, hours without rejected ones` : "no episodes");
    setText(find("list_error"), "");
  } catch (error) {
    if (number !== asked) return;
    setText(find("list_error"), `The hours are not up to date: ${error.message}`);
  }
}

function showAddress() {
  const { filters } = readQuery(location.search);
  const origin = new URLSearchParams(location.search).get("origin") ?? "recorded";
  for (const name of NAMES) form.elements[name].value = filters[name];
  form.elements.origin.value = origin === "any" ? "" : origin;
}

form.addEventListener("input", () => {
  history.replaceState(null, "", pagePath(`${location.pathname}?${address()}`));
  refresh();
});
form.addEventListener("submit", (event) => event.preventDefault());
const { task, operator } = readQuery(location.search).filters;
await listChoices(form, { task, operator });
showAddress();
await repeat(refresh, REFRESH_MS);
