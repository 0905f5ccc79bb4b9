// Recorder controls: buttons and one-key shortcuts → POST /v1/recorder/ACTION; what is allowed follows the state.

import { setText } from "./dom.js";
import { stopwatch } from "./format.js";

const CONFIRM_MS = 3000;

export class RecorderPanel {
  constructor(root) {
    this.root = root;
    this.find = (id) => document.getElementById(id);
    this.buttons = [...root.querySelectorAll("button[data-action]")];
    this.recorder = null;
    this.received_ms = 0;
    this.asked = null;
    this.asked_until_ms = 0;
    for (const button of this.buttons) button.addEventListener("click", () => this.act(button.dataset.action));
    document.addEventListener("keydown", (event) => this.onKey(event));
    this.find("prompt").addEventListener("submit", (event) => event.preventDefault());
    setInterval(() => this.tick(), 100);
    this.enable();
  }

  onKey(event) {
    const typing = event.target instanceof HTMLInputElement || event.target instanceof HTMLSelectElement;
    if (typing || event.repeat || event.ctrlKey || event.metaKey || event.altKey) return;
    const button = this.buttons.find((candidate) => candidate.dataset.key === event.key.toLowerCase());
    if (!button || button.disabled) return;
    event.preventDefault();
    this.act(button.dataset.action);
  }

  // Throwing a take away, or keeping one with holes, takes the same key twice.
  confirmed(action, question) {
    const now_ms = performance.now();
    if (this.asked === action && now_ms < this.asked_until_ms) {
      this.asked = null;
      return true;
    }
    this.asked = action;
    this.asked_until_ms = now_ms + CONFIRM_MS;
    this.say(`${question} Once more within three seconds to do it.`, "WARN");
    return false;
  }

  body(action) {
    if (action === "arm") {
      return { task: this.find("task").value.trim(), instruction: this.find("instruction").value.trim(), domain: this.find("domain").value };
    }
    if (action === "save") {
      const outcome = this.find("outcome").value;
      const success = outcome === "" ? {} : { success: outcome === "true" };
      return { ...success, accept_incomplete: !this.recorder.complete };
    }
    return {};
  }

  async act(action) {
    if (action === "discard" && !this.confirmed(action, "Discard this take?")) return;
    if (action === "rerecord" && !this.confirmed(action, "Discard this take and arm the same task again?")) return;
    if (action === "save" && !this.recorder.complete && !this.confirmed(action, "This take is incomplete. Save it anyway?")) return;
    if (action === "arm" && !this.find("prompt").reportValidity()) return;
    const body = this.body(action);
    try {
      const answer = await fetch(`/v1/recorder/${action}`, {
        method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body),
      });
      const data = await answer.json();
      if (answer.ok) {
        this.say("", "OK");
        this.show(data);
      } else {
        this.say(data.detail ?? data.title ?? `refused (${answer.status})`, "ERROR");
      }
    } catch (error) {
      this.say(`The dashboard did not answer: ${error.message}`, "ERROR");
    }
  }

  say(text, level) {
    const note = this.find("recorder_note");
    note.dataset.level = level;
    setText(note, text);
    this.spoken = text !== "";
  }

  show(recorder) {
    const before = this.recorder?.state;
    this.recorder = recorder;
    this.received_ms = performance.now();
    const state = this.find("recorder_state");
    state.dataset.state = recorder.state;
    setText(state, recorder.state);
    if (before !== recorder.state || !this.spoken) this.say(recorder.note, recorder.level);
    this.spoken = recorder.note === "" ? this.spoken : false;
    this.enable();
    this.tick();
  }

  enable() {
    const allowed = new Set(this.recorder?.actions ?? []);
    for (const button of this.buttons) button.disabled = !allowed.has(button.dataset.action);
    const locked = ["recording", "checking"].includes(this.recorder?.state);
    for (const id of ["task", "instruction", "domain"]) this.find(id).disabled = locked;
  }

  tick() {
    if (!this.recorder) return;
    const running_s = this.recorder.state === "recording" ? (performance.now() - this.received_ms) / 1000 : 0;
    setText(this.find("recorder_clock"), stopwatch((this.recorder.elapsed_s ?? 0) + running_s));
  }
}
