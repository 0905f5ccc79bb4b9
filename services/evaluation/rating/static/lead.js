// For whoever leads the rating: progress and agreement by task, raters, and their links.

import { at, attempt, request } from "./request.js";

const ask = async (path, body) => (await request(path, { key: at("key").value, body })).json();
const number = (value) => (typeof value === "number" ? value.toFixed(2) : "–");
const range = (pair) => (Array.isArray(pair) ? `${number(pair[0])} … ${number(pair[1])}` : "");
const made = (tag, fields) => Object.assign(document.createElement(tag), fields);
const small = (textContent) => made("small", { textContent });

function fill(table, [head, ...others]) {
  const line = (cells, tag) => {
    const row = made("tr");
    cells.forEach((cell, column) => {
      const one = row.appendChild(made(tag));
      if (tag === "td") one.dataset.head = head[column];
      one.append(...[cell].flat());
    });
    return row;
  };
  at(table).replaceChildren(line(head, "th"), ...others.map((cells) => line(cells, "td")));
}

function bar({ alpha, alpha_interval: interval }) {
  const [low, high] = Array.isArray(interval) ? interval : [alpha, alpha];
  const found = made("div", { className: "alpha" });
  for (const [name, place] of Object.entries({ low, high, at: alpha })) found.style.setProperty(`--${name}`, Math.min(Math.max(place, 0), 1));
  return found;
}

function revoke(name) {
  const button = made("button", { textContent: "Revoke", ariaLabel: `Revoke the link of ${name}` });
  button.addEventListener("click", () => attempt(() => ask(`invitations/${name}/revoke`, {}).then(show)));
  return button;
}

async function show() {
  const [{ rollouts, tasks }, links] = await Promise.all([ask("agreement"), ask("invitations")]);
  fill("agreement", [["task", "rated", "score", "alpha", "agreement", "ties open / settled"], ...Object.entries(rollouts).map(([name, total]) => {
    const task = tasks[name] ?? { num_rollouts: 0, conflicts: { open: 0, settled: 0 }, comment: "Nothing is rated yet." };
    const agreed = [typeof task.alpha === "number" ? bar(task) : "", small(task.comment)];
    return [name.replaceAll("_", " "), `${task.num_rollouts} of ${total}`, [number(task.score), small(range(task.score_interval))],
      [number(task.alpha), small(range(task.alpha_interval))], agreed, `${task.conflicts.open} / ${task.conflicts.settled}`];
  })]);
  const counts = {};
  for (const { rater } of links) counts[rater] = 0;
  for (const { marks } of Object.values(tasks)) for (const [rater, count] of Object.entries(marks)) counts[rater] = (counts[rater] ?? 0) + count;
  const biases = Object.entries(tasks).flatMap(([task, { raters }]) => raters.map((one) => ({ ...one, task: task.replaceAll("_", " ") })));
  fill("raters", [["rater", "rollouts", "scores more (+) or less (−) than others", "link", "action"], ...Object.keys(counts).sort().map((name) => {
    const link = links.find(({ rater }) => rater === name);
    const differences = biases.filter(({ rater }) => rater === name).map((one) => small(`${one.task}: ${one.bias > 0 ? "+" : ""}${number(one.bias)} (${range(one.bias_interval)})`));
    const state = link ? `${link.state.replace("_link", "")}, until ${link.ends_at.slice(0, 10)}` : "none, has a key";
    return [name, `${counts[name]}`, differences, state, link?.state === "valid" ? revoke(name) : ""];
  })]);
  at("progress").textContent = `as of ${new Date().toTimeString().slice(0, 5)}`;
  [at("lead").hidden, at("enter").hidden] = [false, true];
}

at("enter").addEventListener("submit", (event) => { event.preventDefault(); void attempt(show); });
at("invite").addEventListener("submit", (event) => {
  event.preventDefault();
  void attempt(async () => {
    const { link } = await ask("invitations", { rater: at("rater").value, days: Number(at("days").value) });
    at("link").value = location.origin + link;
    at("made").hidden = false;
    at("link").select();
    await show();
  });
});
// While people rate. What is said of a refused invitation stays, and old tables say that they are.
setInterval(() => {
  if (at("lead").hidden || document.hidden) return;
  void show().catch(({ message }) => (at("progress").textContent = `${at("progress").textContent.split(";")[0]}; not refreshed: ${message}`));
}, 15000);
