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
    this.discard_until_ms = 0;
    for (const button of this.buttons) button.addEventListener("click", () => this.act(button.dataset.action));
    document.addEventListener("keydown", (event) => this.onKey(event));
    this.find("prompt").addEventListener("submit", (event) => event.preventDefault());
    setInterval(() => this.tick(), 100);
    this.enable();
  }

  onKey(event) {
    const typing = event.target instanceof HTMLInputElement;
    if (typing || event.repeat || event.ctrlKey || event.metaKey || event.altKey) return;
    const button = this.buttons.find((candidate) => candidate.dataset.key === event.key.toLowerCase());
    if (!button || button.disabled) return;
    event.preventDefault();
    this.act(button.dataset.action);
  }

  async act(action) {
    if (action === "discard" && performance.now() > this.discard_until_ms) {
      this.discard_until_ms = performance.now() + CONFIRM_MS;
      this.say("Discard this take? Press D or the button again within three seconds.", "WARN");
      return;
    }
    if (action === "arm" && !this.find("prompt").reportValidity()) return;
    const body = action === "arm"
      ? { task: this.find("task").value.trim(), instruction: this.find("instruction").value.trim() }
      : {};
    this.discard_until_ms = 0;
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
    for (const id of ["task", "instruction"]) this.find(id).disabled = locked;
  }

  tick() {
    if (!this.recorder) return;
    const running_s = this.recorder.state === "recording" ? (performance.now() - this.received_ms) / 1000 : 0;
    setText(this.find("recorder_clock"), stopwatch((this.recorder.elapsed_s ?? 0) + running_s));
  }
}
