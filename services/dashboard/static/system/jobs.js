// Alignments that wait or run, which can be cancelled in two steps, and studies that run.

import { get, getIfServed, post } from "../catalog/api.js";
import { element, levelBadge, repeat, say, setText, why } from "../dom.js";
import { age } from "../format.js";
import { pagePath } from "../session.js";
import { progress } from "../study_parts.js";
import { twoStep } from "./two_step.js";

const PERIOD_MS = 2000;
const MAX_RUNNING = 20;
const MAX_WAITING = 10;
const NONE = { alignments: [], num_matching: 0 };

function share(value) {
  const bar = element("progress", { max: 1, value, "aria-label": "progress" });
  return element("span", { class: "progress" }, bar, `${Math.round(100 * value)} %`);
}

export class Jobs {
  constructor(body, note, empty) {
    this.body = body;
    this.note = note;
    this.empty = empty;
    this.rows = new Map();
    this.alignments = [];
    this.numHidden = 0;
    this.studies = [];
  }

  start() {
    repeat(() => this.refresh(), PERIOD_MS);
  }

  showStudies(studies) {
    this.studies = studies.filter((one) => one.is_running);
    this.draw();
  }

  async refresh() {
    try {
      const [running, waiting] = await Promise.all([
        getIfServed(`/v1/alignment/alignments?state=running&limit=${MAX_RUNNING}`, NONE),
        getIfServed(`/v1/alignment/alignments?state=waiting&limit=${MAX_WAITING}`, NONE)]);
      this.alignments = [...running.alignments, ...waiting.alignments];
      this.numHidden = running.num_matching + waiting.num_matching - this.alignments.length;
      this.draw();
    } catch (error) {
      say(this.note, `Alignments: ${error.message}`, "ERROR");
    }
  }

  async cancel(job) {
    const path = `/v1/alignment/alignments/${encodeURIComponent(job.alignment_id)}`;
    try {
      await post(`${path}/cancel`, {});
      say(this.note, `Alignment of ${job.recording_id} cancelled.`);
    } catch (error) {
      const now = await get(path).catch(() => null);
      say(this.note, `Alignment of ${job.recording_id}: ${error.message}${now ? ` (it is ${now.state})` : ""}`, "ERROR");
    }
    await this.refresh();
  }

  // Rows stay while their job does, so that a click never falls between two buttons.
  row(key, make) {
    if (!this.rows.has(key)) this.rows.set(key, element("tr", { "data-job": key }, ...make()));
    return this.rows.get(key);
  }

  alignmentRow(job) {
    const row = this.row(`alignment ${job.alignment_id}`, () => [
      element("td"),
      element("td", { class: "name" }, element("a", { href: pagePath(`/episodes/recording/${encodeURIComponent(job.recording_id)}`) }, job.recording_id)),
      element("td", {}, "alignment"), element("td"), element("td", { class: "free" }), element("td", { class: "number" }),
      element("td", { class: "act" }, twoStep("Cancel", () => this.cancel(job)))]);
    const running = job.state === "running";
    row.cells[0].replaceChildren(levelBadge(running ? "OK" : "STALE", job.state));
    row.cells[3].replaceChildren(running ? share(job.progress) : "–");
    setText(row.cells[4], [job.stage, job.stream, job.attempts > 1 ? `attempt ${job.attempts}` : null].filter(Boolean).join(" · "));
    setText(row.cells[5], age(job.eta_s));
    return row;
  }

  studyRow(study) {
    const row = this.row(`study ${study.name}`, () => [
      element("td", {}, levelBadge("OK", "running")),
      element("td", { class: "name" }, element("a", { href: pagePath(`/studies/${encodeURIComponent(study.name)}`) }, study.title || study.name),
        study.title && study.title !== study.name ? why(study.name) : null),
      element("td", {}, "study"), element("td"), element("td", { class: "free" }), element("td", { class: "number" }, "–"), element("td")]);
    row.cells[3].replaceChildren(progress(study));
    setText(row.cells[4], study.num_failed ? `${study.num_failed} rollouts failed` : "");
    return row;
  }

  draw() {
    const rows = [...this.alignments.map((job) => this.alignmentRow(job)), ...this.studies.map((one) => this.studyRow(one))];
    for (const [key, row] of this.rows) if (!rows.includes(row)) this.rows.delete(key);
    const more = this.numHidden > 0
      ? [element("tr", {}, element("td", { colspan: 7, class: "free" }, `and ${this.numHidden} more alignments`))] : [];
    const wanted = [...rows, ...more];
    // Moving a row would take the focus from its button.
    if (more.length || wanted.length !== this.body.rows.length || wanted.some((row, index) => row !== this.body.rows[index])) {
      this.body.replaceChildren(...wanted);
    }
    this.empty.hidden = wanted.length > 0;
  }
}
