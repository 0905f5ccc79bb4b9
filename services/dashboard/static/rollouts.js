// The rollouts screen: open rollouts of all worlds, and the newest steps of the one that is watched.

import { ComparisonPanel } from "./comparison.js";
import { element, find, levelBadge, onClick, say, setText } from "./dom.js";
import { HandCanvas } from "./hands.js";
import { LiveLink } from "./live.js";
import { ask, pagePath } from "./requests.js";
import { outcomeOf, showRollouts, stateOf, uncertaintyOf } from "./rollout_rows.js";
import { drawRgb, imageOf, readSteps, StepPlayer, touchOf } from "./steps.js";
import { onTheme } from "./theme.js";

const heatmap = await (await ask("/v1/heatmap")).json();
const hands = Object.fromEntries(["left", "right"].map((side) =>
  [side, new HandCanvas(find(`hand_${side}`), { summary: find(`hand_${side}_text`) }, side, heatmap)]));

let listed = { worlds: [], rollouts: [], over: [], problems: [], num_open: 0 };
let watched = null; // { topic, rollout } of the rollout that is shown
let steps = null;

const comparison = new ComparisonPanel(heatmap);
const player = new StepPlayer(showStep);

function topicOf(rollout) {
  return `rollout/${rollout.service}/${rollout.watch_id}`;
}

function worldOf({ service, world }) {
  return listed.worlds.find((one) => one.service === service && one.name === world);
}

function watch(rollout) {
  if (watched) link.show(watched.topic, false);
  watched = rollout ? { topic: topicOf(rollout), rollout } : null;
  steps = null;
  player.load(0);
  find("watched").hidden = !watched;
  find("watched_images").replaceChildren();
  setText(find("step_text"), "");
  for (const hand of Object.values(hands)) hand.clear("no steps yet");
  note(watched ? "Waiting for the newest steps." : "");
  history.replaceState(null, "", pagePath(watched ? `#${watched.topic}` : location.pathname));
  if (watched) {
    about(rollout);
    link.show(watched.topic, true);
  }
  showTable();
}

const note = (text, level) => say(find("watched_note"), text, level);

function about(rollout) {
  const { level, word } = stateOf(rollout);
  find("watched_about").replaceChildren(levelBadge(level, word),
    element("strong", {}, `${rollout.world}: ${rollout.task}`),
    element("span", { class: "quiet" }, rollout.instruction),
    rollout.isOver ? element("strong", {}, outcomeOf(rollout)) : "",
    element("span", { class: "quiet" }, `policy ${rollout.client || "not named"}, seed ${rollout.seed}`));
}

function showTable() {
  showRollouts(find("rollout_rows"), listed, watched?.rollout.watch_id, watch);
}

function showListed(view) {
  listed = view;
  comparison.offer(view);
  setText(find("summary"), `${view.num_open} open`);
  find("world_list").replaceChildren(...view.worlds.map((world) => element("li", { title: world.tasks.join(", ") },
    element("strong", {}, world.name), element("span", { class: "quiet" }, `${world.kind}, ${world.tasks.length} tasks`))));
  find("problems").replaceChildren(...view.problems.map((text) => element("p", { class: "note", "data-level": "WARN" }, text)));
  const isWatched = (one) => topicOf(one) === watched?.topic;
  const now = view.rollouts.find(isWatched);
  const over = view.over.find(isWatched);
  if (now) {
    watched.rollout = now;
    about(now);
  } else if (over) {
    // What was shown last stays, with what came of it; so it does while a world does not answer.
    about({ ...over, isOver: true });
  } else if (!watched) {
    const named = view.rollouts.find((one) => `#${topicOf(one)}` === location.hash);
    if (named) watch(named);
  }
  showTable();
}

function showSteps(message) {
  if (message.header.topic !== watched?.topic) return;
  steps = message;
  const { observation, rollout } = message.header;
  const reliability = uncertaintyOf({ ...watched.rollout, ...rollout, doubt: observation.doubt });
  if (rollout.ended) note(`The world ended this rollout: ${rollout.ended}`, "ERROR");
  else if (observation.doubt?.outside) note(`Unreliable steps: ${reliability.reason}`, "WARN");
  else if (reliability.reason) note(reliability.reason, "WARN");
  else note(message.cameras.length ? "" : "The policy asks for no images, so none are shown: watching makes a world render nothing.");
  const row = find("watched_images");
  row.replaceChildren(...message.cameras.map((camera) => element("figure", {},
    element("canvas", { class: "rgb", role: "img", "aria-label": `image of ${camera.name}`, "data-camera": camera.name }),
    element("figcaption", {}, camera.name.replace(/^camera_/, "").replaceAll("_", " ")))));
  find("step").max = message.header.steps.length - 1;
  player.load(message.header.steps.length, watched.rollout.model_rate_hz);
}

function showStep(index) {
  const { header, cameras } = steps;
  for (const camera of cameras) {
    const canvas = find("watched_images").querySelector(`[data-camera="${CSS.escape(camera.name)}"]`);
    drawRgb(canvas, camera.height, camera.width, imageOf(camera, index));
  }
  for (const [side, hand] of Object.entries(hands)) {
    const touch = touchOf(steps, index, side);
    hand.use(worldOf(watched.rollout)?.tactile_layout ?? null);
    if (touch) hand.update(touch);
    else hand.clear("the policy asks for no touch");
  }
  find("step").value = index;
  const thinned = header.steps.length < header.num_steps ? `, ${header.steps.length} of ${header.num_steps} steps of the chunk are sent` : "";
  const chunk = header.rollout.next_chunk;
  setText(find("step_text"), `${chunk ? `chunk ${chunk - 1}` : "start"}, step ${header.steps[index]}${thinned}`);
  find("watched").dataset.step = header.steps[index];
}

const link = new LiveLink({
  topics: { rollouts: showListed, comparison: (view) => comparison.show(view) },
  onOther: (topic, data) => {
    if (topic !== watched?.topic) return;
    note(`${data.gone ? "This rollout is over: " : ""}${data.note}`, "WARN");
    if (data.gone && !listed.over.some((one) => topicOf(one) === topic)) about({ ...watched.rollout, isOver: true });
  },
  onBinary: (buffer) => {
    const message = readSteps(buffer);
    if (message) showSteps(message);
  },
  onLost: () => showListed({ ...listed, problems: ["No link to the dashboard: what you see is old."] }),
});

new IntersectionObserver((entries) => {
  for (const entry of entries) if (watched) link.show(watched.topic, entry.isIntersecting);
}).observe(find("watched"));
function pause(isPaused) {
  player.pause(isPaused);
  setText(find("pause"), isPaused ? "Play" : "Pause");
}

onClick({ stop_watching: () => watch(null), pause: () => pause(!player.paused) });
find("step").addEventListener("input", (event) => {
  pause(true);
  player.goTo(Number(event.target.value));
});
const draw = () => {
  player.tick();
  comparison.player.tick();
  comparison.driving.tick();
  requestAnimationFrame(draw);
};
requestAnimationFrame(draw);
onTheme(() => {
  for (const hand of Object.values(hands)) hand.request();
  comparison.redraw();
});
