// The list of recordings and episodes: filters in the address, rows that move on, deletion in two steps.

import { attempt, cell, element, find, newestOnly, onSubmit, repeat, setText, why } from "../dom.js";
import { bytes, plural } from "../format.js";
import { get, getIfServed, listChoices, newestJobs, pagePath, post } from "../requests.js";
import { ExportDialog } from "./export.js";
import { Grid, listen, say, showSelected } from "./grid.js";
import { itemsOf, playerPath, rowsOf, showLineage, stageOf, subjectOf } from "./items.js";
import * as cells from "./items.js";
import { FILTERS, isFiltered, PAGE_ROWS, pageWords, readQuery, storeQuery, writeQuery } from "./query.js";

const REFRESH_MS = 3000;
const CONFIRM_MS = 5000;
const TYPING_MS = 250;
const MAX_MOVED = 500;
const form = find("filters");
let query = readQuery(location.search);
let rows = new Map();
let total = 0;
let deletion = null;
let lastMoved = [];

// Rows

function itemRow({ item, job }) {
  return element("tr", {}, cells.pickCell(item.id), cells.timeCell(item.at), cells.taskCell(item), cells.nameCell(item, pagePath(playerPath(item))),
    cells.operatorCell(item), cells.stationCell(item), cells.outcomeCell(item), cells.lengthCell(item), cells.qualityCell(item),
    cells.stageCell(stageOf({ item, job })));
}

function uploadRow({ id, task, station, upload }) {
  return element("tr", {}, cell(""), cell("just now"), cell(element("strong", {}, task ?? "–")),
    cell([element("span", { class: "clipped item_name" }, id), why("recording")], "item_name_cell"),
    cell("–"), cell(station ?? "–"), cell("–"), cell("–", "number"), cell("–"), cells.stageCell(stageOf({ upload })));
}

function trashRow(item) {
  return element("tr", {}, cells.pickCell(item.id), cells.timeCell(item.deleted_at),
    cell([element("span", { class: "item_name" }, item.id), why(item.kind)], "item_name_cell"), cell(bytes(item.num_bytes), "number"));
}

// Requests

async function listed() {
  if (query.view === "trash") {
    const trash = await get(`/v1/episode_store/trash?limit=${PAGE_ROWS * query.page}`);
    const items = trash.items.slice(PAGE_ROWS * (query.page - 1));
    const made = items.map((item) => ({ key: `${item.kind}/${item.id}/${item.deleted_at}`, item, build: () => trashRow(item) }));
    return { made, total: trash.num_items };
  }
  const isFirstPage = query.page === 1 && query.view !== "episode" && query.sort === "time" && query.descending && !isFiltered(query);
  const [page, uploads, pending] = await Promise.all([
    get(`/v1/episode_store/catalog/items?${storeQuery(query)}`),
    isFirstPage ? getIfServed("/v1/acquisition/uploads", []) : [],
    isFirstPage ? getIfServed("/v1/episode_store/uploads", { uploads: [] }) : { uploads: [] },
  ]);
  const unaligned = page.items.filter((item) => item.kind === "recording" && !item.episodes.length);
  const jobs = await newestJobs(unaligned.map((item) => item.id));
  const found = rowsOf({ items: page.items, uploads, pending: pending.uploads, jobs, isFirstPage });
  return { made: found.map((row) => ({ ...row, build: () => (row.item ? itemRow(row) : uploadRow(row)) })), total: page.num_matching };
}

function nothing() {
  if (query.view === "trash") return ["The trash is empty."];
  if (isFiltered(query)) return ["Nothing matches these filters."];
  return ["Nothing is stored yet. Record a take on ", element("a", { href: pagePath("/") }, "Station"), ", or run ",
    element("code", {}, "dextouch demo"), " with the same data folder: its episodes appear here."];
}

const refresh = newestOnly(listed, ({ made, total: counted }) => {
  total = counted;
  rows = new Map(made.map((row) => [row.key, row]));
  grid.show(made.map(({ key, build, ...state }) => ({ key, build, state: JSON.stringify([query.view, state]) })));
  find("empty").hidden = made.length > 0;
  find("empty").replaceChildren(...nothing());
  setText(find("list_error"), "");
  showPager();
}, (error) => setText(find("list_error"), `The list is not up to date: ${error.message}`));

// Address and filters

function go(changes, { isTyping = false } = {}) {
  query = { ...query, page: 1, ...changes };
  history[isTyping ? "replaceState" : "pushState"](null, "", pagePath(`${location.pathname}${writeQuery(query)}`));
  showQuery();
  refresh();
}

function showQuery() {
  document.body.dataset.view = query.view;
  for (const tab of document.querySelectorAll("[data-view-tab]")) tab.setAttribute("aria-pressed", String(tab.dataset.viewTab === query.view));
  for (const name of FILTERS) if (document.activeElement !== form.elements[name]) form.elements[name].value = query.filters[name];
  for (const head of document.querySelectorAll("[data-sort]")) {
    const isSorted = query.view !== "trash" && head.dataset.sort === query.sort;
    head.parentElement.setAttribute("aria-sort", isSorted ? (query.descending ? "descending" : "ascending") : "none");
  }
  find("clear").hidden = !isFiltered(query);
}

function showPager() {
  setText(find("range"), pageWords(query.page, total));
  find("previous").disabled = query.page === 1;
  find("next").disabled = query.page * PAGE_ROWS >= total;
}

// Selection and what is done with it

function chosen() {
  return grid.meant().map((key) => rows.get(key)).filter((row) => row?.item);
}

function showSelection() {
  showSelected(grid);
  const aligned = alignable();
  find("align").disabled = !aligned.length;
  setText(find("align").firstElementChild, aligned.some((row) => row.job) ? "Align again" : "Align");
  for (const id of ["delete", "restore", "lineage"]) find(id).disabled = !chosen().length;
  if (deletion && deletion.keys !== grid.meant().join()) endDeletion();
}

function alignable() {
  return chosen().filter(({ item, job }) => item.kind === "recording" && !item.episodes?.length && !["waiting", "running"].includes(job?.state));
}

async function move(path, items) {
  const refused = [];
  const moved = [];
  for (let first = 0; first < items.length; first += MAX_MOVED) {
    const answer = await post(path, { items: items.slice(first, first + MAX_MOVED) });
    moved.push(...answer.moved);
    refused.push(...answer.refused);
  }
  return { moved, refused };
}

function reasons(refused) {
  return refused.length ? ` Not moved: ${refused.slice(0, 3).map((one) => one.reason).join("; ")}${refused.length > 3 ? "; …" : ""}` : "";
}

function endDeletion() {
  if (deletion) clearTimeout(deletion.timer);
  deletion = null;
  setText(find("delete").firstElementChild, "Delete");
  find("delete").classList.remove("asked");
}

async function remove() {
  const meant = chosen();
  if (query.view === "trash" || !meant.length) return;
  const items = meant.flatMap((row) => itemsOf(row, query.view));
  if (!deletion) {
    const kinds = ["recording", "episode"].map((kind) => [kind, items.filter((item) => item.kind === kind).length]);
    const counted = kinds.filter(([, count]) => count).map(([kind, count]) => plural(count, kind)).join(" and ");
    deletion = { keys: grid.meant().join(), timer: setTimeout(() => { endDeletion(); say(""); }, CONFIRM_MS) };
    setText(find("delete").firstElementChild, "Delete now");
    find("delete").classList.add("asked");
    say(`Move ${counted} to the trash? Once more within five seconds, by Delete or the button.`, "WARN");
    return;
  }
  endDeletion();
  await act(async () => {
    const { moved, refused } = await move("/v1/episode_store/trash", items);
    lastMoved = moved;
    grid.select([...grid.selected], false);
    say(`${plural(moved.length, "item")} in the trash; Z brings back.${reasons(refused)}`, refused.length ? "ERROR" : "OK");
  });
}

async function restore(items) {
  if (!items.length) return;
  await act(async () => {
    const { moved, refused } = await move("/v1/episode_store/trash/restore", items);
    lastMoved = [];
    say(`${plural(moved.length, "item")} restored.${reasons(refused)}`, refused.length ? "ERROR" : "OK");
  });
}

async function align() {
  const recording_ids = alignable().map(({ item }) => item.id);
  if (!recording_ids.length) return;
  await act(async () => {
    await post("/v1/alignment/alignments", { recording_ids });
    say(`${plural(recording_ids.length, "recording")} given to alignment.`);
  });
}

async function act(work) {
  await attempt(find("message"), work);
  await refresh();
}

function open(key) {
  const item = rows.get(key)?.item;
  if (item && query.view !== "trash") location.assign(pagePath(playerPath(item)));
}

const KEYS = {
  delete: remove,
  r: () => query.view === "trash" && restore(chosen().map(({ item }) => ({ kind: item.kind, id: item.id }))),
  z: () => restore(lastMoved),
  g: align,
  l: () => query.view !== "trash" && chosen().length && showLineage(find("lineage_dialog"), lineageSubject()),
  e: () => query.view !== "trash" && exporting.open(query, grid.selected.size ? chosen().map(({ item }) => item) : []),
  escape: () => { endDeletion(); say(""); grid.select([...grid.selected], false); },
  arrowleft: () => query.page > 1 && go({ page: query.page - 1 }),
  arrowright: () => query.page * PAGE_ROWS < total && go({ page: query.page + 1 }),
  "/": () => form.elements.text.focus(),
};

function lineageSubject() {
  const row = rows.get(grid.active) ?? chosen()[0];
  return row.item.kind === "recording" ? { kind: "recording", id: row.item.id } : subjectOf(row.item);
}

const exporting = new ExportDialog(find("export_dialog"));
const grid = new Grid(find("rows"), { onChange: () => showSelection(), onOpen: open });
let typed = null;
let changed = {};
form.addEventListener("input", (event) => {
  clearTimeout(typed);
  changed[event.target.name] = event.target.value;
  const isTyping = event.target.name === "text";
  typed = setTimeout(() => {
    go({ filters: { ...query.filters, ...changed } }, { isTyping });
    changed = {};
  }, isTyping ? TYPING_MS : 0);
});
onSubmit(form, () => { document.activeElement?.blur(); grid.focus(); });
find("clear").addEventListener("click", () => go({ filters: Object.fromEntries(FILTERS.map((name) => [name, ""])) }));
for (const tab of document.querySelectorAll("[data-view-tab]")) tab.addEventListener("click", () => { endDeletion(); say(""); go({ view: tab.dataset.viewTab }); });
for (const head of document.querySelectorAll("[data-sort]")) {
  head.addEventListener("click", () => go({ sort: head.dataset.sort, descending: head.dataset.sort === query.sort ? !query.descending : ["time", "duration", "findings"].includes(head.dataset.sort) }));
}
listen(grid, { form, actions: KEYS, buttons: [["previous", "arrowleft"], ["next", "arrowright"], ["delete", "delete"], ["restore", "r"], ["align", "g"], ["lineage", "l"], ["export", "e"]] });
window.addEventListener("popstate", () => { query = readQuery(location.search); showQuery(); refresh(); });
showQuery();
const { task, operator, station } = query.filters;
await listChoices(form, { task, operator, station });
await repeat(refresh, REFRESH_MS);
