// One study: its tables, sorted as the operator wants, and its rollouts, disagreements first; what it has none of is hidden.

import { attempt, button, cell, element, find, headRow, newestOnly, onClick, say, setText } from "./dom.js";
import { LiveLink } from "./live.js";
import { ask, checked, get, getIfServed } from "./requests.js";
import { FIGURES, agreementRow, rateCell, rateRows, rolloutRow, stateBadge, studyProgress } from "./study_tables.js";

// Missing values come last in either direction.
function sorted(rows, valueOf, descending) {
  return [...rows].sort((a, b) => {
    const [one, other] = [valueOf(a) ?? null, valueOf(b) ?? null];
    if (one === null || other === null) return (one === null) - (other === null);
    return (descending ? -1 : 1) * (typeof one === "string" ? one.localeCompare(other) : one - other);
  });
}

const PAGE = 50;
const RETRY_MS = 5000;
const name = decodeURIComponent(location.pathname.split("/").pop());
const base = `/v1/studies/studies/${encodeURIComponent(name)}`;
const playable = new Map(); // episode id → whether the dashboard's store has it
let figures = null;
let order = { key: "task", descending: false };
let filter = null; // disagreements where there are any, else all, until the operator chooses
let rows = [];

function sortColumn(key, label) {
  const sort = button(label, () => {
    order = { key, descending: order.key === key ? !order.descending : key.startsWith("world:") };
    showRates();
  }, { class: "sort" });
  return [sort, { "aria-sort": order.key === key ? (order.descending ? "descending" : "ascending") : "none" }];
}

function showTable(id, heads, rows) {
  find(id).tHead.replaceChildren(headRow(heads));
  find(id).tBodies[0].replaceChildren(...rows);
}

function showRates() {
  const worlds = ["real", ...figures.summary.worlds];
  const valueOf = order.key.startsWith("world:")
    ? (row) => row.worlds[order.key.slice("world:".length)]?.rate : (row) => row[order.key];
  const heads = [sortColumn("task", "Task"), sortColumn("policy", "Policy"), ...worlds.map((world) => sortColumn(`world:${world}`, world === "real" ? "real" : `${world} (imagined)`))];
  showTable("rates", heads, sorted(rateRows(figures.rates), valueOf, order.descending).map((row) =>
    element("tr", { "data-task": row.task, "data-policy": row.policy }, cell(row.task), cell(row.policy, "name"),
      ...worlds.map((world) => rateCell(row.worlds[world], ({ world: of, task, policy }) => open({ world: of, task, policy }))))));
}

function showFigures() {
  const { summary, meanings } = figures;
  setText(find("study_title"), summary.title || summary.name);
  find("study_state").replaceChildren(stateBadge(summary), studyProgress(summary));
  setText(find("summary"), summary.worlds.length ? `${figures.num_disagreements} imagined outcomes differ from the real ones` : "no imagined world to compare");
  setText(find("rate_meaning"), `${meanings.rate} Cannot tell: ${meanings.unreliable}`);
  find("meanings").replaceChildren(...[...FIGURES, ["interval", "Intervals"]].flatMap(([key, label]) => [element("dt", {}, label), element("dd", {}, meanings[key])]));
  showRates();
  const chance = "share of all pairings of the policies' rates that correlate at least as well";
  const numbers = [...FIGURES.map(([, label]) => label), "Chance", "Policies × starts"];
  const heads = numbers.map((label) => [label, { class: "number", title: label === "Chance" ? chance : null }]);
  showTable("agreement", ["World", "Task", ...heads, "Comments"], figures.agreement.map(agreementRow));
  showChoices(summary);
  find("agreement_section").hidden = figures.agreement.length === 0;
  find("rollouts_section").hidden = summary.num_done === 0;
  find("only_disagreements").hidden = figures.num_disagreements === 0 && !filter?.disagreements;
}

// The picture that goes into a paper, in the colours of this page; its links give it on white.
const showPicture = newestOnly(async () => {
  const query = { world: find("picture_world").value, task: find("picture_task").value };
  const address = (form) => `${base}/picture?${new URLSearchParams({ ...query, form })}`;
  for (const form of ["svg", "png", "tex"]) find(`picture_${form}`).href = address(form);
  return (await checked(await ask(address("svg")))).text();
}, (text) => find("picture").replaceChildren(document.importNode(new DOMParser().parseFromString(text, "image/svg+xml").documentElement, true)),
(error) => find("picture").replaceChildren(element("p", { class: "note", "data-level": "ERROR" }, error.message)));

function showChoices({ worlds, tasks }) {
  const options = (values) => values.map((value) => element("option", { value }, value || "all tasks"));
  if (find("picture_world").length === 0) {
    find("picture_world").replaceChildren(...options(worlds));
    find("picture_task").replaceChildren(...options(tasks.length > 1 ? ["", ...tasks] : tasks));
  }
  if (worlds.length) showPicture();
}

// One request for all: at most two episodes a rollout of a page.
async function findPlayable(found) {
  const ids = [...new Set(found.flatMap((one) => [one.episode_id, one.real_episode_id]))].filter((id) => id && !playable.has(id));
  if (!ids.length) return;
  const query = new URLSearchParams([["kind", "episode"], ["limit", 2 * PAGE], ...ids.map((id) => ["id", id])]);
  const { items } = await getIfServed(`/v1/episode_store/catalog/items?${query}`, { items: [] });
  const stored = new Set(items.map(({ id }) => id));
  for (const id of ids) playable.set(id, stored.has(id));
}

function showRollouts(total) {
  const kept = new Set([...playable].filter(([, has]) => has).map(([id]) => id));
  const number = { class: "number" };
  const heads = ["Agrees", "World", "Task", "Policy", ["Seed", number], "Outcome", "Real outcome", ["Probe", number], "Cannot tell", "Play"];
  showTable("rollouts", heads, rows.map((row) => rolloutRow(row, kept)));
  const of = filter.world ? ` of ${filter.policy} in ${filter.world}, ${filter.task}` : "";
  const what = filter.disagreements ? "outcomes that differ between a world and the real one" : "rollouts, those that differ from the real one first";
  const missing = rows.some((row) => row.episode_id) && rows.every((row) => !row.episode_id || playable.has(row.episode_id)) && !rows.some((row) => kept.has(row.episode_id) || kept.has(row.real_episode_id))
    ? " They are not in this dashboard's episode store, so they cannot be played here: run the study with --store." : "";
  say(find("rollouts_note"), `${rows.length} of ${total} ${what}${of}.${missing}`);
  find("more").hidden = rows.length >= total;
  find("only_disagreements").setAttribute("aria-pressed", String(Boolean(filter.disagreements)));
  find("all_rollouts").setAttribute("aria-pressed", String(!filter.disagreements));
}

function load(offset) {
  const requested = filter;
  return attempt(find("rollouts_note"), async () => {
    const { rollouts, num_matching } = await get(`${base}/rollouts?${new URLSearchParams({ ...filter, limit: PAGE, offset })}`);
    if (requested !== filter) return;
    rows = offset ? [...rows, ...rollouts] : rollouts;
    showRollouts(num_matching);
    await findPlayable(rollouts);
    if (requested === filter) showRollouts(num_matching);
  });
}

function open(chosen) {
  filter = chosen;
  find("rollouts_title").scrollIntoView({ block: "start", behavior: "smooth" });
  return load(0);
}

async function refresh() {
  try {
    figures = await get(base);
    showFigures();
    const none = figures.summary.num_done ? "" : "No rollout has a result yet; the first ones appear here as the study runs.";
    say(find("study_note"), none);
    filter ??= figures.num_disagreements ? { disagreements: true } : {};
    if (rows.length <= PAGE) await load(0);
  } catch (error) {
    say(find("study_note"), error.message, "ERROR");
    setTimeout(refresh, RETRY_MS);
  }
}

let newest = "";
function showStudies({ studies, note }) {
  const study = studies.find((one) => one.name === name);
  if (!study && note) say(find("study_note"), note, "ERROR");
  const now = JSON.stringify(study ?? null);
  if (now === newest) return;
  newest = now;
  refresh();
}

new LiveLink({ topics: { studies: showStudies } });
onClick({ only_disagreements: () => open({ disagreements: true }), all_rollouts: () => open({}), more: () => load(rows.length) });
for (const name of ["picture_world", "picture_task"]) find(name).addEventListener("change", showPicture);
