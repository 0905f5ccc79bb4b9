// Real against imagined: starts a replay, follows it as its chunks arrive, and goes back to any step.

import { chunkOf, difference, uncertaintyAt, firstUnreliable, readChunk, SIDES, stepOf } from "./comparison_chunks.js";
import { ComparisonCharts } from "./comparison_charts.js";
import { element, setText } from "./dom.js";
import { number } from "./format.js";
import { HandCanvas } from "./hands.js";
import { drawRgb } from "./rgb_canvas.js";
import { badge, uncertaintyOf } from "./rollout_rows.js";
import { ask } from "./session.js";
import { StepPlayer } from "./step_player.js";

const LEVELS = { running: "OK", finished: "OK", stopped: "STALE", failed: "ERROR" };
const find = (id) => document.getElementById(id);

export class ComparisonPanel {
  constructor(heatmap) {
    this.view = null;
    this.chunks = [];
    this.loading = false;
    this.hands = Object.fromEntries(SIDES.map((world) => [world, Object.fromEntries(["left", "right"].map((side) =>
      [side, new HandCanvas(find(`${world}_${side}`), { summary: find(`${world}_${side}_text`) }, side, heatmap)]))]));
    this.charts = new ComparisonCharts(find("charts"), (step) => this.goTo(step));
    this.player = new StepPlayer({ show: (step) => this.showStep(step) });
    find("replay").addEventListener("submit", (event) => {
      event.preventDefault();
      this.start(find("replay_episode").value.trim());
    });
    find("replay_stop").addEventListener("click", () => this.post("/v1/comparisons/stop"));
    find("comparison_step").addEventListener("input", (event) => this.goTo(Number(event.target.value)));
    find("comparison_pause").addEventListener("click", () => this.pause(!this.player.paused));
    find("replay_episode").addEventListener("focus", () => this.suggest(), { once: true });
    const wanted = new URLSearchParams(location.search).get("replay");
    if (wanted) find("replay_episode").value = wanted;
  }

  async post(path, body) {
    const options = { method: "POST" };
    if (body) Object.assign(options, { headers: { "content-type": "application/json" }, body: JSON.stringify(body) });
    const answer = await ask(path, options);
    if (!answer.ok) this.note((await answer.json()).detail ?? `refused (${answer.status})`, "ERROR");
    return answer.ok;
  }

  async start(episode_id) {
    this.note("Starting.");
    if (await this.post("/v1/comparisons", { episode_id })) this.note("");
  }

  async suggest() {
    const answer = await ask("/v1/episode_store/episodes?domain=robot&limit=50").catch(() => null);
    if (!answer?.ok) return;
    const { episodes } = await answer.json();
    // Those of a station have no seed, by which the twin places its objects.
    const seeded = episodes.filter((one) => one.origin !== "recorded");
    find("episodes").replaceChildren(...seeded.map((one) => element("option", { value: one.episode_id }, one.task)));
  }

  note(text, level = "") {
    find("comparison_note").dataset.level = level;
    setText(find("comparison_note"), text);
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
    if (view.state === "none") return;
    const isNew = this.view?.id !== view.id;
    this.view = view;
    if (isNew) {
      this.chunks = [];
      this.player.load(0);
      this.pause(false);
    }
    find("comparison_state").replaceChildren(badge({ level: LEVELS[view.state], word: view.state }),
      element("span", {}, `${view.task}, ${view.episode_id}`),
      element("span", { class: "quiet" }, `step ${Math.max(0, view.pixel_error.length - 1)} of ${view.num_steps}`));
    find("replay_stop").hidden = view.state !== "running";
    if (view.note) this.note(view.note, view.state === "failed" ? "ERROR" : "WARN");
    find("compared").hidden = view.pixel_error.length === 0;
    this.charts.show(view);
    this.load();
  }

  // Chunks are fetched one after the other, in order, and played as they come.
  async load() {
    if (this.loading) return;
    this.loading = true;
    try {
      while (this.view && this.chunks.length < this.view.num_chunks) {
        const { id, rate_hz } = this.view;
        const answer = await ask(`/v1/comparisons/${id}/chunks/${this.chunks.length}`);
        if (!answer.ok || this.view.id !== id) break;
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
    find("imagined_uncertainty").dataset.outside = Boolean(earlier);
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
