// Recorder controls: buttons and one-key shortcuts → POST /v1/recorder/ACTION; what is allowed follows the state.

import { element, setText } from "./dom.js";
import { stopwatch } from "./format.js";
import { ask } from "./session.js";

const CONFIRM_MS = 3000;
const FIELDS = ["task", "instruction", "domain", "operator", "consent"];
const UNFOLDED = 3;

export class RecorderPanel {
  constructor(root) {
    this.root = root;
    this.find = (id) => document.getElementById(id);
    this.buttons = [...root.querySelectorAll("button[data-action]")];
    this.outcomes = [...root.querySelectorAll("input[name=outcome]")];
    this.recorder = null;
    this.received_ms = 0;
    this.judged_id = null;
    this.armed = "";
    this.asked = null;
    this.message = { text: "", level: "OK", until_ms: 0 };
    for (const button of this.buttons) {
      if (button.type === "button") button.addEventListener("click", () => this.act(button.dataset.action));
    }
    for (const outcome of this.outcomes) outcome.addEventListener("change", () => this.judge());
    document.addEventListener("keydown", (event) => this.onKey(event));
    const prompt = this.find("prompt");
    prompt.addEventListener("submit", (event) => {
      event.preventDefault();
      document.activeElement?.blur();
      this.act("arm");
    });
    prompt.addEventListener("input", () => this.enable());
    // Consent is one person's: another operator is asked again.
    this.find("operator").addEventListener("input", () => { this.find("consent").checked = false; });
    setInterval(() => this.tick(), 100);
    this.enable();
  }

  onKey(event) {
    const target = event.target;
    const typing = target instanceof HTMLSelectElement || (target instanceof HTMLInputElement && !["checkbox", "radio"].includes(target.type));
    if (typing && event.key === "Escape") target.blur();
    if (typing || event.repeat || event.ctrlKey || event.metaKey || event.altKey) return;
    const key = event.key.toLowerCase();
    const outcome = this.outcomes.find((candidate) => candidate.dataset.key === key);
    const button = this.buttons.find((candidate) => candidate.dataset.key === key);
    if (outcome && this.recorder?.state === "checking") {
      event.preventDefault();
      outcome.checked = true;
      this.judge();
    } else if (button && this.allows(button.dataset.action)) {
      event.preventDefault();
      this.act(button.dataset.action);
    }
  }

  allows(action) {
    return (this.recorder?.actions ?? []).includes(action);
  }

  // The operator's word on this take: true, false, null (not judged), or undefined while nothing was chosen.
  outcome() {
    const chosen = this.outcomes.find((candidate) => candidate.checked);
    return chosen && JSON.parse(chosen.value);
  }

  judge() {
    this.say("", "OK");
    this.enable();
  }

  fields() {
    const text = (id) => this.find(id).value.trim();
    return { task: text("task"), instruction: text("instruction"), domain: text("domain"),
      operator: text("operator") || null, consent: this.find("consent").checked };
  }

  // Whether the fields say something else than the take that is armed.
  changed() {
    const armed = this.recorder?.state === "armed" ? this.recorder.prompt : null;
    const fields = this.fields();
    return armed !== null && FIELDS.some((name) => fields[name] !== armed[name]);
  }

  // Throwing a take away, or keeping one with holes, takes the same key twice.
  confirmed(action, question) {
    const now_ms = performance.now();
    if (this.asked === action && now_ms < this.message.until_ms) {
      this.asked = null;
      return true;
    }
    this.say(`${question} Once more within three seconds to do it.`, "WARN", CONFIRM_MS);
    this.asked = action;
    return false;
  }

  body(action) {
    if (action === "arm") return this.fields();
    // Named, so that a page that is behind cannot act on another take than the one it shows.
    const take = action !== "record" && this.recorder.recording_id ? { recording_id: this.recorder.recording_id } : {};
    if (action === "save") return { ...take, success: this.outcome(), accept_incomplete: !this.recorder.complete };
    return take;
  }

  ready(action) {
    if (action === "record" && this.changed()) return false;
    if (action === "save" && this.outcome() === undefined) return false;
    if (action === "discard") return this.confirmed(action, "Discard this take?");
    if (action === "rerecord") return this.confirmed(action, "Discard this take and arm the same task again?");
    if (action === "save" && !this.recorder.complete) return this.confirmed(action, "This take is incomplete. Save it anyway?");
    return action !== "arm" || this.find("prompt").reportValidity();
  }

  async act(action) {
    if (!this.ready(action)) {
      this.tick();
      return;
    }
    const body = this.body(action);
    try {
      const answer = await ask(`/v1/recorder/${action}`, {
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

  say(text, level, lasts_ms = Infinity) {
    this.asked = null;
    this.message = { text, level, until_ms: performance.now() + lasts_ms };
    this.tick();
  }

  // What the operator has to do next, while nothing else is to be said.
  hint() {
    if (this.changed()) return "The fields changed since this take was armed: arm again (A).";
    if (this.recorder?.state === "checking" && this.outcome() === undefined) return "How did this take end? Success (Y), failure (N) or not judged (U).";
    return "";
  }

  show(recorder) {
    const before = this.recorder?.state;
    this.recorder = recorder;
    this.received_ms = performance.now();
    const state = this.find("recorder_state");
    state.dataset.state = recorder.state;
    setText(state, recorder.state);
    this.forgetOutcome(recorder);
    this.takePrompt(recorder);
    this.showProblems(recorder);
    if (before !== recorder.state) this.say("", "OK");
    this.enable();
    this.tick();
  }

  // An outcome belongs to one take: it is asked anew at every other.
  forgetOutcome(recorder) {
    const judged_id = recorder.state === "checking" ? recorder.recording_id : null;
    if (judged_id === null || judged_id !== this.judged_id) for (const outcome of this.outcomes) outcome.checked = false;
    this.judged_id = judged_id;
  }

  // A prompt that another page armed, or this one before it was loaded anew, is what the fields say.
  takePrompt(recorder) {
    const armed = ["armed", "recording", "checking"].includes(recorder.state) ? JSON.stringify(recorder.prompt ?? null) : "";
    if (armed !== this.armed && armed !== "" && recorder.prompt) {
      for (const name of FIELDS.slice(0, 4)) this.find(name).value = recorder.prompt[name] ?? "";
      this.find("consent").checked = recorder.prompt.consent;
    }
    this.armed = armed;
  }

  showProblems(recorder) {
    const problems = recorder.problems ?? [];
    const details = this.find("recorder_problems");
    const list = this.find("recorder_problem_list");
    details.hidden = recorder.note === "";
    details.classList.toggle("plain", problems.length === 0);
    const note = this.find("recorder_note");
    note.dataset.level = recorder.level;
    setText(note, recorder.note);
    if ([...list.children].map((item) => item.textContent).join("\n") === problems.join("\n")) return;
    list.replaceChildren(...problems.map((problem) => element("li", {}, problem)));
    details.open = problems.length > 0 && problems.length <= UNFOLDED;
  }

  enable() {
    for (const button of this.buttons) button.disabled = !this.allows(button.dataset.action);
    const blocked = { record: this.changed(), save: this.outcome() === undefined };
    for (const button of this.buttons) button.disabled ||= blocked[button.dataset.action] ?? false;
    const state = this.recorder?.state;
    this.find("outcome").disabled = state !== "checking";
    for (const id of FIELDS) this.find(id).disabled = ["recording", "checking"].includes(state);
  }

  tick() {
    const lasts = performance.now() < this.message.until_ms && this.message.text !== "";
    const message = this.find("recorder_message");
    message.dataset.level = lasts ? this.message.level : "WARN";
    setText(message, lasts ? this.message.text : this.hint());
    this.find("outcome").classList.toggle("wanted", this.recorder?.state === "checking" && this.outcome() === undefined);
    if (!this.recorder) return;
    const running_s = this.recorder.state === "recording" ? (performance.now() - this.received_ms) / 1000 : 0;
    setText(this.find("recorder_clock"), stopwatch((this.recorder.elapsed_s ?? 0) + running_s));
  }
}
