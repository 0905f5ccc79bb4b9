// Real against imagined: replays an episode or moves hands, follows the chunks as they arrive, and goes back to any step.

import { css } from "./canvas.js";
import { attempt, element, find, levelBadge, onClick, onSubmit, say, setText, showChildren } from "./dom.js";
import { number } from "./format.js";
import { HandDriving } from "./hand_driving.js";
import { HandCanvas } from "./hands.js";
import { ask, get, post } from "./requests.js";
import { uncertaintyOf } from "./rollout_rows.js";
import { chunkOf, difference, drawRgb, firstUnreliable, readChunk, SIDES, stepOf, StepPlayer, uncertaintyAt } from "./steps.js";
import uPlot from "./vendor/uplot/uPlot.esm.js";

const HEIGHT = 150;
// Above it a share of the bound is drawn at the upper edge.
const MOST = 3;
const PLOTS = [
  { key: "pixel_error", label: "Pixel error", range: (max) => [0, Math.max(max, 5)] },
  { key: "pressure_error_kpa", label: "Pressure error, kPa", range: (max) => [0, Math.max(max, 0.2)] },
  { key: "contact_f1", label: "Contact F1", range: () => [0, 1] },
];
const STRIP = { key: "uncertainty", label: "Uncertainty of the world model, as a share of its bound", range: (max) => [0, Math.min(MOST, Math.max(1.3, max))], isStrip: true };

// Values of a plot; F1 says nothing where neither world has contact, and the start is given, not imagined.
function series(view, key) {
  if (key === "contact_f1") return view.contact_f1.map((value, step) => (view.in_contact[step] ? value : null));
  if (key !== "uncertainty") return view[key];
  return [null, ...view.uncertainties.flatMap((one) => Array(one.last_step - one.first_step + 1).fill(one.bound_share === null ? null : Math.min(MOST, one.bound_share)))];
}

class ComparisonCharts {
  constructor(frame, strip, onStep) {
    Object.assign(this, { frames: [[frame, PLOTS, HEIGHT], [strip, [STRIP], 130]], onStep, view: null, step: 0, plots: [] });
    const observer = new ResizeObserver(() => this.rebuild());
    observer.observe(frame);
    observer.observe(strip);
  }

  rebuild() {
    for (const { made } of this.plots) made.destroy();
    this.plots = this.view ? this.frames.flatMap(([frame, plots, height]) => {
      const width = Math.floor(frame.clientWidth / plots.length) - (plots.length > 1 ? 12 : 0);
      return width > 120 ? plots.map((plot) => ({ key: plot.key, made: this.plot(plot, width, height, frame) })) : [];
    }) : [];
  }

  plot({ key, label, range, isStrip }, width, height, frame) {
    const axis = { stroke: css("--quiet"), grid: { stroke: css("--line"), width: 1 }, ticks: { stroke: css("--line") }, size: 42 };
    const time = isStrip ? { values: (_, steps) => steps.map((step) => `${(step / this.view.rate_hz).toFixed(1)} s`) } : {};
    const made = new uPlot({
      width, height, title: label, legend: { show: false }, cursor: { drag: { x: false, y: false }, y: false },
      scales: { x: { time: false, range: () => [0, Math.max(1, this.view.num_steps)] }, y: { range: (_, low, high) => range(high ?? 0) } },
      axes: [{ ...axis, size: 28, ...time }, axis],
      series: [{}, { stroke: css("--accent"), width: 1.8, points: { show: false } }],
      hooks: { drawClear: [(plot) => this.shade(plot)], draw: [(plot) => this.mark(plot, isStrip)] },
    }, this.data(key), frame);
    made.over.addEventListener("click", () => this.onStep(made.posToIdx(made.cursor.left)));
    made.root.dataset.figure = key;
    return made;
  }

  data(key) {
    const values = series(this.view, key);
    return [values.map((_, step) => step), values];
  }

  band(plot, from, to, colour) {
    const left = plot.valToPos(from, "x", true);
    plot.ctx.fillStyle = colour;
    plot.ctx.fillRect(left, plot.bbox.top, Math.max(1.5, plot.valToPos(to, "x", true) - left), plot.bbox.height);
  }

  // From the first unreliable chunk on, since every later step goes on from it.
  get left() {
    return this.view.uncertainties.find(({ uncertainty }) => uncertainty?.outside)?.first_step ?? null;
  }

  shade(plot) {
    if (this.left !== null) this.band(plot, this.left, this.view.uncertainties.at(-1).last_step, css("--warn_ground"));
  }

  mark(plot, isStrip) {
    if (this.left !== null) this.band(plot, this.left, this.left, css("--warn"));
    if (isStrip) {
      plot.ctx.fillStyle = css("--warn");
      for (let x = plot.bbox.left; x < plot.bbox.left + plot.bbox.width; x += 8) plot.ctx.fillRect(x, plot.valToPos(1, "y", true), 4, 1.5);
    }
    this.band(plot, this.step, this.step, css("--ink"));
  }

  show(view) {
    const other = this.view?.id !== view.id || this.plots.length === 0;
    this.view = view;
    if (other) this.rebuild();
    else for (const { key, made } of this.plots) made.setData(this.data(key));
  }

  goTo(step) {
    this.step = step;
    for (const { made } of this.plots) made.redraw(false);
  }
}

const OUTCOMES = { true: "success", false: "failure", null: "outcome unknown" };
const RETRY_MS = 2000;
const LEVELS = { running: "OK", finished: "OK", stopped: "STALE", failed: "ERROR" };

// Values of a list with their words; what was chosen stays chosen.
function fill(list, choices, chosen = list.value) {
  showChildren(list, choices.map(([value, text]) => element("option", { value }, text)));
  if (choices.some(([value]) => value === chosen)) list.value = chosen;
}

export class ComparisonPanel {
  constructor(heatmap) {
    Object.assign(this, { view: null, chunks: [], loading: false });
    this.hands = Object.fromEntries(SIDES.map((world) => [world, Object.fromEntries(["left", "right"].map((side) =>
      [side, new HandCanvas(find(`${world}_${side}`), { summary: find(`${world}_${side}_text`) }, side, heatmap)]))]));
    this.charts = new ComparisonCharts(find("charts"), find("uncertainty_strip"), (step) => this.goTo(step));
    this.player = new StepPlayer((step) => this.showStep(step));
    this.driving = new HandDriving(find("drive_pad"), find("drive_sides"), async (moves) => this.show(await post(`/v1/comparisons/${this.view.id}/moves`, moves)));
    onSubmit(find("replay"), () => this.start({ episode_id: find("replay_episode").value }));
    onSubmit(find("drive"), async () => {
      if (await this.start({ task: find("drive_task").value, seed: Number(find("drive_seed").value) })) find("drive_pad").focus();
    });
    onClick({
      replay_stop: () => attempt(find("comparison_note"), () => post("/v1/comparisons/stop")),
      comparison_pause: () => this.pause(!this.player.paused),
      go_to_moment: () => this.goTo(this.charts.left),
    });
    for (const one of [window, find("replay_episode")]) one.addEventListener("focus", () => this.offerAgain());
    find("comparison_step").addEventListener("input", (event) => this.goTo(Number(event.target.value)));
  }

  say(text, level) {
    say(find("comparison_note"), text, level);
  }

  // Whether it began.
  start(request) {
    this.say("Starting.");
    return attempt(find("comparison_note"), async () => {
      const view = await post("/v1/comparisons", request);
      this.say("");
      this.show(view);
      return true;
    });
  }

  // Robot episodes of tasks that the world model knows, with one that the address names, and tasks to move hands in.
  async offer(listed) {
    this.listed = listed;
    const tasksOf = (kind) => listed.worlds.find((one) => one.kind === kind)?.tasks ?? [];
    const [real, imagined] = [tasksOf("twin"), tasksOf("model")];
    const key = JSON.stringify([real, imagined, listed.has_episodes]);
    if (key === this.offered) return;
    this.offered = key;
    clearTimeout(this.retry);
    const both = real.filter((task) => imagined.includes(task));
    fill(find("drive_task"), both.map((task) => [task, task]));
    find("drive").hidden = both.length === 0;
    let found = [];
    let problem = "";
    try {
      if (listed.has_episodes) found = (await get("/v1/episode_store/episodes?domain=robot&limit=100")).episodes;
    } catch (error) {
      problem = `Episodes cannot be listed: ${error.message}`;
    }
    if (this.offered !== key) return;
    // The episodes of before stay.
    if (problem) this.retry = setTimeout(() => this.offerAgain(), RETRY_MS);
    else this.fillEpisodes(found, real, imagined);
    const none = find("replay_episode").value ? "" : !listed.has_episodes ? "Replays need an episode store: this dashboard was started without DEXTOUCH_DASHBOARD_EPISODE_STORE_URL."
      : "No robot episode of a task that the world model knows yet: dextouch demo records one, dextouch twin record as many as you want.";
    setText(find("offer_note"), problem || (imagined.length ? none : "Replays need a world model: dextouch up serves one."));
  }

  offerAgain() {
    this.offered = null;
    if (this.listed) this.offer(this.listed);
  }

  fillEpisodes(found, real, imagined) {
    // Those of a station have no seed, by which the twin places its objects.
    const suitable = found.filter(({ task, origin }) => imagined.includes(task) && (origin === "recorded" || real.includes(task)));
    const list = find("replay_episode");
    const wanted = list.value || new URLSearchParams(location.search).get("replay");
    const named = wanted && !suitable.some((one) => one.episode_id === wanted) ? [[wanted, wanted]] : [];
    fill(list, [...named, ...suitable.map((one) => [one.episode_id,
      `${one.task}: ${one.episode_id}, ${one.duration_s.toFixed(1)} s, ${OUTCOMES[one.success]}, against ${one.origin === "recorded" ? "its recording" : "the twin"}`])], wanted);
    find("replay_button").disabled = !list.value;
  }

  pause(paused) {
    this.player.pause(paused);
    setText(find("comparison_pause"), paused ? "Play" : "Pause");
  }

  goTo(step) {
    this.pause(true);
    this.player.goTo(step);
  }

  show(view) {
    if (view.state === "none") {
      // The dashboard was started again since; what has arrived stays.
      if (this.view?.state === "running") this.show({ ...this.view, state: "stopped", num_chunks: this.chunks.length });
      return;
    }
    const isNew = this.view?.id !== view.id;
    this.view = view;
    if (isNew) {
      this.chunks = [];
      this.player.load(0);
      this.pause(false);
    }
    find("comparison_state").replaceChildren(levelBadge(LEVELS[view.state], view.state),
      element("span", {}, `${view.task}, ${view.episode_id || `hands moved by you, seed ${view.seed}`}`),
      element("span", { class: "quiet" }, `step ${Math.max(0, view.pixel_error.length - 1)} of ${view.num_steps}`));
    find("replay_stop").hidden = view.state !== "running";
    find("drive_pad").hidden = view.state !== "running" || view.episode_id !== "";
    for (const name of document.querySelectorAll(".real_name")) setText(name, view.worlds.real === "recording" ? "Recording" : "Twin");
    if (view.note || isNew) this.say(view.note, view.state === "failed" ? "ERROR" : "WARN");
    find("compared").hidden = view.pixel_error.length === 0;
    this.charts.show(view);
    this.showMoment();
    this.load();
  }

  // When the imagination left what its model knows, in words, and what both worlds say about the outcome.
  showMoment() {
    const { uncertainties, rate_hz, real_success, num_steps } = this.view;
    const first = uncertainties.find((one) => one.uncertainty?.outside);
    const shares = uncertainties.map((one) => one.bound_share).filter((share) => share !== null);
    const within = shares.length ? `Within what it knows so far: at most ${number(100 * Math.max(...shares), 0)} % of its bound.` : "This world model reports no share of a bound.";
    setText(find("moment"), first ? `Leaves what it knows at ${(first.first_step / rate_hz).toFixed(1)} s (step ${first.first_step}): ${first.uncertainty.reason}. What follows is unreliable.` : within);
    find("moment").dataset.level = first ? "WARN" : "";
    find("go_to_moment").hidden = !first;
    const imagined = uncertainties.at(-1)?.uncertainty?.success_probability ?? null;
    const isWhole = this.view.pixel_error.length > num_steps;
    setText(find("outcomes"), isWhole && (real_success !== null || imagined !== null) ? `Real: ${OUTCOMES[real_success]}. Imagined: ${imagined === null ? "no estimate" : `success with ${(100 * imagined).toFixed(0)} %`}.` : "");
  }

  // Chunks are fetched one after the other, in order, and played as they come.
  async load() {
    if (this.loading) return;
    this.loading = true;
    try {
      while (this.view && this.chunks.length < this.view.num_chunks) {
        const { id, rate_hz } = this.view;
        const answer = await ask(`/v1/comparisons/${id}/chunks/${this.chunks.length}`).catch(() => null);
        if (!answer?.ok || this.view.id !== id) break;
        const chunk = readChunk(await answer.arrayBuffer());
        this.chunks.push(chunk);
        const count = chunk.first_step + chunk.num_steps;
        find("comparison_step").max = count - 1;
        this.player.extend(count, rate_hz);
      }
    } finally {
      this.loading = false;
    }
  }

  showStep(step) {
    const chunk = chunkOf(this.chunks, step);
    if (!chunk) return;
    const worlds = stepOf(chunk, step);
    for (const world of SIDES) {
      drawRgb(find(`${world}_image`), chunk.height, chunk.width, worlds[world].rgb);
      for (const side of ["left", "right"]) this.hands[world][side].update(worlds[world][side]);
    }
    drawRgb(find("difference_image"), chunk.height, chunk.width, difference(worlds.real.rgb, worlds.imagined.rgb));
    const said = uncertaintyAt(this.view.uncertainties, step);
    const earlier = firstUnreliable(this.view.uncertainties, step);
    const uncertainty = said ? uncertaintyOf({ doubt: said.uncertainty, rollout_doubt: earlier, kind: "model", next_chunk: 1 }) : { text: "given, not imagined", reason: "" };
    find("imagined_uncertainty").closest("figure").dataset.outside = Boolean(earlier);
    const words = said?.uncertainty?.outside ? `unreliable: ${uncertainty.reason}` : earlier ? uncertainty.reason : said ? `uncertainty ${uncertainty.text}` : uncertainty.text;
    setText(find("imagined_uncertainty"), words);
    const { pixel_error, pressure_error_kpa, contact_f1, in_contact } = this.view;
    setText(find("comparison_text"), `step ${step}: pixels ${number(pixel_error[step], 2)}, pressure ${number(pressure_error_kpa[step], 3, "kPa")}, `
      + `contact F1 ${in_contact[step] ? number(contact_f1[step], 2) : "undefined (no contact)"}`);
    find("comparison_step").value = step;
    find("compared").dataset.step = step;
    this.charts.goTo(step);
  }

  redraw() {
    this.charts.rebuild();
    for (const world of SIDES) for (const hand of Object.values(this.hands[world])) hand.request();
  }
}
