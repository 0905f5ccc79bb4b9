// The review queue: what needs a look first, accepted or rejected by keys; the store remembers it.

import { attempt, cell, element, find, keep, kept, newestOnly, onSubmit, repeat, setText } from "../dom.js";
import { plural } from "../format.js";
import { get, getIfServed, listChoices, pagePath, post } from "../requests.js";
import { Grid, listen, say, showSelected } from "./grid.js";
import { playerPath, reasonOf, showLineage, subjectOf } from "./items.js";
import * as cells from "./items.js";

const MAX_FAILED = 200;

// The last job of each recording whose alignment failed, newest first.
function failedRecordings(alignments) {
  const newest = alignments.filter((job) => job.state === "failed").reverse().slice(0, MAX_FAILED);
  return new Map(newest.map((job) => [job.recording_id, job]));
}

// Recordings that could not be aligned first, then what the store flagged, in its order.
function queueOf(flagged, { jobs, items }) {
  const key = (item) => `${item.kind}/${item.id}`;
  const failed = items.filter((item) => !item.episodes.length).map((item) => ({ key: key(item), item, job: jobs.get(item.id) }));
  const known = new Set(failed.map((one) => one.key));
  return [...failed, ...flagged.map((item) => ({ key: key(item), item })).filter((one) => !known.has(one.key))];
}

// A verdict on a take is one on all its episodes, or on its recording while it has none.
function reviewedItems({ kind, id, episodes }) {
  return kind === "recording" && episodes.length ? episodes.map((one) => ({ kind: "episode", id: one })) : [{ kind, id }];
}

function fewWords(groups, { task, origin }) {
  const few = groups.filter((one) => !one.is_compared && (!task || one.task === task) && (!origin || one.origin === origin));
  if (!few.length) return "";
  const names = few.slice(0, 8).map((one) => `${one.task} (${plural(one.num_items, `${one.domain} ${one.kind}`)})`);
  const more = few.length > 8 ? `, and ${few.length - 8} more` : "";
  return `Too few to be compared, at least ${few[0].min_items} are needed: ${names.join(", ")}${more}.`;
}

const REFRESH_MS = 5000;
const MAX_ROWS = 100;
const MAX_ITEMS = 500;
const form = find("filters");
const dialog = find("reject_dialog");
const reasons = dialog.querySelector("form").elements;
let rows = new Map();
let last = [];
let rejected = [];

function row({ item, job }) {
  const findings = item.findings.map((finding) => element("li", { "data-code": finding.code }, finding.message));
  if (job) findings.unshift(element("li", { "data-code": "alignment_failed", title: job.problem?.detail }, `alignment failed: ${reasonOf(job)}`));
  return element("tr", {}, cells.pickCell(item.id), cell(element("ul", { class: "findings" }, ...findings)), cells.timeCell(item.at), cells.taskCell(item),
    cells.nameCell(item, pagePath(playerPath(item))), cells.operatorCell(item), cells.outcomeCell(item), cells.lengthCell(item));
}

// Requests

function requested(more) {
  const query = new URLSearchParams({ review: "not_reviewed", ...more });
  for (const name of ["task", "origin"]) if (form.elements[name].value) query.set(name, form.elements[name].value);
  return query;
}

async function failed() {
  const { alignments } = await getIfServed("/v1/alignment/alignments?state=failed&limit=1000", { alignments: [] });
  const jobs = failedRecordings(alignments);
  if (!jobs.size) return { jobs, items: [] };
  const query = requested({ kind: "recording", limit: String(MAX_ROWS) });
  for (const id of jobs.keys()) query.append("id", id);
  const { items } = await get(`/v1/episode_store/catalog/items?${query}`);
  return { jobs, items };
}

function read() {
  const query = requested({ flagged: "true", sort: "findings", descending: "true", limit: String(MAX_ROWS) });
  return Promise.all([get(`/v1/episode_store/catalog/items?${query}`), failed(), get("/v1/episode_store/catalog/groups")]);
}

const refresh = newestOnly(read, ([page, unaligned, { groups }]) => {
  const queue = queueOf(page.items, unaligned);
  rows = new Map(queue.map((one) => [one.key, one]));
  grid.show(queue.map((one) => ({ key: one.key, state: JSON.stringify(one), build: () => row(one) })));
  const more = Math.max(page.num_matching - page.items.length, 0);
  setText(find("left"), queue.length ? `${queue.length + more} to review${more ? `, the first ${queue.length} listed` : ""}` : "");
  find("empty").hidden = queue.length > 0;
  setText(find("few"), fewWords(groups, { task: form.elements.task.value, origin: form.elements.origin.value }));
  setText(find("list_error"), "");
}, (error) => setText(find("list_error"), `The queue is not up to date: ${error.message}`));

async function review(items, verdict, reason = "") {
  const words = { accepted: "accepted", rejected: "rejected", null: "in the queue again" };
  await attempt(find("message"), async () => {
    const refused = [];
    const reviewer = form.elements.reviewer.value.trim() || null;
    for (let first = 0; first < items.length; first += MAX_ITEMS) {
      const answer = await post("/v1/episode_store/catalog/reviews", { items: items.slice(first, first + MAX_ITEMS), verdict, reason, reviewer });
      refused.push(...answer.refused);
    }
    last = verdict === null ? [] : items;
    grid.select([...grid.selected], false);
    const done = items.length - refused.length;
    say(`${done} ${words[verdict]}${reason ? `: ${reason}` : ""}.${refused.length ? ` Refused: ${refused[0].reason}` : ""}`, refused.length ? "ERROR" : "OK");
  });
  find("undo").disabled = !last.length;
  await refresh();
}

// Actions

function meant() {
  return grid.meant().map((key) => rows.get(key)).filter((one) => one);
}

function meantItems() {
  return meant().flatMap(({ item }) => reviewedItems(item));
}

function askReason() {
  const count = meant().length;
  if (!count) return;
  // The rows may change while the dialog is open.
  rejected = meantItems();
  setText(find("reject_title"), count === 1 ? `Reject ${meant()[0].item.id}` : `Reject ${count} items`);
  dialog.returnValue = "";
  dialog.showModal();
  (reasons.reason.value === "" ? reasons.other : [...reasons.reason].find((one) => one.checked)).focus();
}

function showReason() {
  const isOther = reasons.reason.value === "";
  reasons.other.disabled = !isOther;
  reasons.other.required = isOther;
  if (isOther) reasons.other.focus();
}

const KEYS = {
  a: () => meant().length && review(meantItems(), "accepted"),
  r: askReason,
  z: () => last.length && review(last, null),
  l: () => meant().length && showLineage(find("lineage_dialog"), subjectOf(rows.get(grid.active)?.item ?? meant()[0].item)),
  escape: () => { say(""); grid.select([...grid.selected], false); },
};

const grid = new Grid(find("rows"), {
  onChange: () => {
    showSelected(grid);
    for (const id of ["accept", "reject", "lineage"]) find(id).disabled = !grid.meant().length;
  },
  onOpen: (key) => location.assign(pagePath(playerPath(rows.get(key).item))),
});

dialog.addEventListener("keydown", (event) => {
  const choice = event.target === reasons.other ? undefined : reasons.reason[Number(event.key) - 1];
  if (!choice) return;
  event.preventDefault();
  choice.checked = true;
  choice.focus();
  showReason();
});
dialog.addEventListener("change", showReason);
dialog.addEventListener("close", () => {
  const reason = reasons.reason.value || reasons.other.value.trim();
  if (dialog.returnValue === "reject" && reason) review(rejected, "rejected", reason);
  grid.focus();
});
listen(grid, { form, actions: KEYS, buttons: [["accept", "a"], ["reject", "r"], ["undo", "z"], ["lineage", "l"]] });

onSubmit(form);
form.addEventListener("input", (event) => {
  if (event.target.name === "reviewer") return keep("reviewer", event.target.value);
  const { task, origin } = form.elements;
  const query = new URLSearchParams({ ...(task.value && { task: task.value }), ...(origin.value !== "recorded" && { origin: origin.value || "any" }) });
  history.replaceState(null, "", pagePath(`${location.pathname}?${query}`));
  return refresh();
});

const given = new URLSearchParams(location.search);
await listChoices(form, { task: given.get("task") ?? "" });
form.elements.origin.value = given.get("origin") === "any" ? "" : given.get("origin") ?? "recorded";
form.elements.reviewer.value = kept("reviewer") ?? "";
await repeat(async () => { if (!dialog.open) await refresh(); }, REFRESH_MS);
