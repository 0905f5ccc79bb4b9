// One study: its tables, sorted as the operator wants, and its rollouts, disagreements first; what it has none of is hidden.

import { get } from "./catalog/api.js";
import { element, find, say, setText } from "./dom.js";
import { LiveLink } from "./live.js";
import { ask, checked } from "./session.js";
import { sorted } from "./sorting.js";
import { progress, stateBadge } from "./study_parts.js";
import { agreementRow, rateCell, rateRows, rolloutRow } from "./study_tables.js";

const PAGE = 50;
const RETRY_MS = 5000;
const name = decodeURIComponent(location.pathname.split("/").pop());
const base = `/v1/studies/studies/${encodeURIComponent(name)}`;
const playable = new Map(); // episode id → whether the dashboard's store has it
let figures = null;
let order = { key: "task", descending: false };
let filter = null; // disagreements where there are any, else all, until the operator chooses
let rows = [];
let pictures = 0; // that were asked for

function sortButton(key, label) {
  const button = element("button", { type: "button", class: "sort" }, label);
  button.addEventListener("click", () => {
    order = { key, descending: order.key === key ? !order.descending : key.startsWith("world:") };
    showRates();
  });
  const direction = order.key === key ? (order.descending ? "descending" : "ascending") : "none";
  return element("th", { scope: "col", "aria-sort": direction }, button);
}

function showRates() {
  const worlds = ["real", ...figures.summary.worlds];
  const valueOf = order.key.startsWith("world:")
    ? (row) => row.worlds[order.key.slice("world:".length)]?.rate : (row) => row[order.key];
  find("rates").tHead.replaceChildren(element("tr", {}, sortButton("task", "Task"), sortButton("policy", "Policy"),
    ...worlds.map((world) => sortButton(`world:${world}`, world === "real" ? "real" : `${world} (imagined)`))));
  find("rates").tBodies[0].replaceChildren(...sorted(rateRows(figures.rates), valueOf, order.descending).map((row) =>
    element("tr", { "data-task": row.task, "data-policy": row.policy }, element("td", {}, row.task), element("td", { class: "name" }, row.policy),
      ...worlds.map((world) => rateCell(row.worlds[world], ({ world: of, task, policy }) => open({ world: of, task, policy }))))));
}

function showFigures() {
  const { summary, meanings } = figures;
  setText(find("study_title"), summary.title || summary.name);
  find("study_state").replaceChildren(stateBadge(summary), progress(summary));
  setText(find("summary"), summary.worlds.length ? `${figures.num_disagreements} imagined outcomes differ from the real ones` : "no imagined world to compare");
  setText(find("rate_meaning"), `${meanings.rate} Cannot tell: ${meanings.unreliable}`);
  const named = [["Pearson", "pearson"], ["Mean absolute error", "mean_absolute_error"], ["MMRV", "mmrv"], ["Bias", "bias"], ["Intervals", "interval"]];
  find("meanings").replaceChildren(...named.flatMap(([label, key]) => [element("dt", {}, label), element("dd", {}, meanings[key])]));
  showRates();
  const heads = [["World", ""], ["Task", ""], ["Pearson", "number"], ["Mean absolute error", "number"], ["MMRV", "number"], ["Bias", "number"], ["Chance", "number"], ["Policies × starts", "number"], ["Comments", ""]];
  const chance = "share of all pairings of the policies' rates that correlate at least as well";
  find("agreement").tHead.replaceChildren(element("tr", {}, ...heads.map(([label, kind]) =>
    element("th", { scope: "col", class: kind || null, title: label === "Chance" ? chance : null }, label))));
  find("agreement").tBodies[0].replaceChildren(...figures.agreement.map(agreementRow));
  showChoices(summary);
  find("agreement_section").hidden = figures.agreement.length === 0;
  find("rollouts_section").hidden = summary.num_done === 0;
  find("only_disagreements").hidden = figures.num_disagreements === 0 && !filter?.disagreements;
}

// The picture that goes into a paper, in the colours of this page; its links give it on white.
async function showPicture() {
  const query = { world: find("picture_world").value, task: find("picture_task").value };
  const address = (form) => `${base}/picture?${new URLSearchParams({ ...query, form })}`;
  for (const form of ["svg", "png", "tex"]) find(`picture_${form}`).href = address(form);
  const number = (pictures += 1);
  let shown;
  try {
    const drawn = new DOMParser().parseFromString(await (await checked(await ask(address("svg")))).text(), "image/svg+xml");
    shown = document.importNode(drawn.documentElement, true);
  } catch (error) {
    shown = element("p", { class: "note", "data-level": "ERROR" }, error.message);
  }
  // Of an older choice, which a newer one has replaced.
  if (number === pictures) find("picture").replaceChildren(shown);
}

function showChoices({ worlds, tasks }) {
  const options = (values) => values.map((value) => element("option", { value }, value || "all tasks"));
  if (find("picture_world").length === 0) {
    find("picture_world").replaceChildren(...options(worlds));
    find("picture_task").replaceChildren(...options(tasks.length > 1 ? ["", ...tasks] : tasks));
  }
  if (worlds.length) showPicture();
}

async function findPlayable(found) {
  const ids = [...new Set(found.flatMap((one) => [one.episode_id, one.real_episode_id]))].filter((id) => id && !playable.has(id));
  const next = async () => {
    for (let id = ids.pop(); id; id = ids.pop()) {
      const answer = await ask(`/v1/episode_store/episodes/${encodeURIComponent(id)}`).catch(() => null);
      playable.set(id, Boolean(answer?.ok));
    }
  };
  await Promise.all([next(), next(), next(), next()]);
}

function showRollouts(total) {
  const kept = new Set([...playable].filter(([, has]) => has).map(([id]) => id));
  const heads = ["Agrees", "World", "Task", "Policy", "Seed", "Outcome", "Real outcome", "Probe", "Cannot tell", "Play"];
  find("rollouts").tHead.replaceChildren(element("tr", {}, ...heads.map((label) =>
    element("th", { scope: "col", class: ["Seed", "Probe"].includes(label) ? "number" : null }, label))));
  find("rollouts").tBodies[0].replaceChildren(...rows.map((row) => rolloutRow(row, kept)));
  const of = filter.world ? ` of ${filter.policy} in ${filter.world}, ${filter.task}` : "";
  const what = filter.disagreements ? "outcomes that differ between a world and the real one" : "rollouts, those that differ from the real one first";
  const missing = rows.some((row) => row.episode_id) && rows.every((row) => !row.episode_id || playable.has(row.episode_id)) && !rows.some((row) => kept.has(row.episode_id) || kept.has(row.real_episode_id))
    ? " They are not in this dashboard's episode store, so they cannot be played here: run the study with --store." : "";
  say(find("rollouts_note"), `${rows.length} of ${total} ${what}${of}.${missing}`);
  find("more").hidden = rows.length >= total;
  find("only_disagreements").setAttribute("aria-pressed", String(Boolean(filter.disagreements)));
  find("all_rollouts").setAttribute("aria-pressed", String(!filter.disagreements));
}

async function load(offset) {
  const asked = filter;
  const query = new URLSearchParams({ ...filter, limit: PAGE, offset });
  try {
    const { rollouts, num_matching } = await get(`${base}/rollouts?${query}`);
    if (asked !== filter) return;
    rows = offset ? [...rows, ...rollouts] : rollouts;
    showRollouts(num_matching);
    await findPlayable(rollouts);
    if (asked === filter) showRollouts(num_matching);
  } catch (error) {
    say(find("rollouts_note"), error.message, "ERROR");
  }
}

function open(wanted) {
  filter = wanted;
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
const link = new LiveLink({
  onTopic: (topic, data) => {
    if (topic !== "studies") return;
    const study = data.studies.find((one) => one.name === name);
    if (!study && data.note) say(find("study_note"), data.note, "ERROR");
    const now = JSON.stringify(study ?? null);
    if (now !== newest) {
      newest = now;
      refresh();
    }
  },
});
link.show("studies", true);
find("only_disagreements").addEventListener("click", () => open({ disagreements: true }));
find("all_rollouts").addEventListener("click", () => open({}));
find("more").addEventListener("click", () => load(rows.length));
for (const name of ["picture_world", "picture_task"]) find(name).addEventListener("change", showPicture);
