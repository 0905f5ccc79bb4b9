// Hours of recorded episodes by task, operator, station and day, by what was said of them in review.

import { cell, element, find, newestOnly, onSubmit, repeat, setText } from "../dom.js";
import { date, number, plural } from "../format.js";
import { get, listChoices, pagePath } from "../requests.js";
import { readQuery, storeQuery } from "./query.js";

const PARTS = ["accepted", "not_reviewed", "rejected"];

// Tasks with a goal have a row even before their first episode.
function withGoals(rows, goals) {
  const there = new Set(rows.map((row) => row.value));
  const none = { num_episodes: 0, accepted_h: 0, not_reviewed_h: 0, rejected_h: 0 };
  const missing = Object.keys(goals).filter((task) => !there.has(task)).sort().map((value) => ({ value, ...none }));
  return [...rows, ...missing].map((row) => ({ ...row, goal_h: goals[row.value] ?? null }));
}

// What may be trained on counts towards a goal: all but what was rejected.
function counted(row) {
  return row.accepted_h + row.not_reviewed_h;
}

function bars(rows) {
  const total = (row) => counted(row) + row.rejected_h;
  const longest_h = Math.max(...rows.map((row) => Math.max(total(row), row.goal_h ?? 0)), 0) || 1;
  return rows.map((row) => ({
    parts: PARTS.map((part) => ({ part, share: row[`${part}_h`] / longest_h })),
    goal: row.goal_h ? row.goal_h / longest_h : null,
    reached: row.goal_h ? counted(row) / row.goal_h : null,
    total_h: total(row),
  }));
}

const REFRESH_MS = 30000;
const FIELDS = ["task", "operator", "station", "day"];
const NAMES = ["origin", "domain", "task", "operator", "from", "to"];
const form = find("filters");
const goals = JSON.parse(find("hours").dataset.goals);

function hours(value_h) {
  if (value_h === 0) return "–";
  return value_h < 1 ? number(60 * value_h, 1, "min") : number(value_h, value_h < 10 ? 2 : 1, "h");
}

function bar({ parts, goal }) {
  const pieces = parts.map(({ part }) => element("span", { class: "bar_part", "data-part": part }));
  parts.forEach(({ share }, index) => { pieces[index].style.width = `${100 * share}%`; });
  const mark = goal === null ? null : element("span", { class: "goal_mark" });
  if (mark) mark.style.left = `${100 * goal}%`;
  return element("div", { class: "bar_frame" }, ...pieces, mark);
}

function row(field, data, drawn) {
  const goal = data.goal_h === null ? "" : `${Math.round(100 * drawn.reached)} % of ${hours(data.goal_h)}`;
  const label = data.value === null ? "not known" : field === "day" ? date(`${data.value}T00:00`, "day") : data.value;
  const figures = [data.accepted_h, data.not_reviewed_h, data.rejected_h, drawn.total_h].map((value_h) => cell(hours(value_h), "number"));
  return element("tr", {}, element("th", { scope: "row", title: label }, element("span", { class: "clipped" }, label)), cell(bar(drawn), "bars"),
    ...figures, cell(String(data.num_episodes), "number"), cell(goal, "number goal"));
}

// Newest days first.
function show(field, rows) {
  const listed = field === "task" ? withGoals(rows, shownGoals()) : rows.map((one) => ({ ...one, goal_h: null }));
  if (field === "day") listed.reverse();
  const drawn = bars(listed);
  find(`${field}_rows`).replaceChildren(...listed.map((one, index) => row(field, one, drawn[index])));
  find(`${field}_empty`).hidden = listed.length > 0;
  return listed;
}

function shownGoals() {
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
  const query = new URLSearchParams(storeQuery({ view: "", sort: "", descending: true, page: 1, filters }));
  for (const name of ["kind", "sort", "descending", "limit", "offset"]) query.delete(name);
  query.set("utc_offset_min", String(-new Date().getTimezoneOffset()));
  return query;
}

function read() {
  const filters = storeFilters();
  return Promise.all(FIELDS.map((field) => get(`/v1/episode_store/catalog/hours/${field}?${filters}`)));
}

const refresh = newestOnly(read, (answers) => {
  const shown = FIELDS.map((field, index) => show(field, answers[index].rows));
  const sum = (of) => shown[0].reduce((total, one) => total + of(one), 0);
  const kept = plural(sum((one) => one.num_episodes), "episode");
  setText(find("total"), shown[0].length ? `${hours(sum(counted))} in ${kept}, hours without rejected ones` : "no episodes");
  setText(find("list_error"), "");
}, (error) => setText(find("list_error"), `The hours are not up to date: ${error.message}`));

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
onSubmit(form);
const { task, operator } = readQuery(location.search).filters;
await listChoices(form, { task, operator });
showAddress();
await repeat(refresh, REFRESH_MS);
