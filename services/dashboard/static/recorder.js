// Recorder panel: buttons, one-key shortcuts and a pedal → POST /v1/recorder/ACTION; what is allowed follows the state.

import { post } from "./catalog/api.js";
import { date } from "./dates.js";
import { element, setText, showChildren } from "./dom.js";
import { stopwatch } from "./format.js";
import { keep, kept } from "./kept.js";
import { Pedal } from "./pedal.js";
import { PromptForm } from "./prompt.js";
import { keyOf, lastTakeWords, nextStep, numSaved, verdict } from "./recorder_logic.js";
import { ResetTimer } from "./reset_timer.js";
import { pagePath } from "./session.js";
import { Sounds } from "./sounds.js";

const CONFIRM_MS = 3000;
const QUESTIONS = {
  discard: "Discard this take?",
  rerecord: "Discard this take and arm the same task again?",
  session: "Count the saved takes from zero?",
};
const SOUNDS = { recording: "start", checking: "stop", saved: "saved" };

export class RecorderPanel {
  constructor(root) {
    this.find = (id) => document.getElementById(id);
    this.buttons = [...root.querySelectorAll("button[data-action]")];
    this.outcomes = [...root.querySelectorAll("input[name=outcome]")];
    this.recorder = null;
    this.level = "STALE";
    this.received_ms = 0;
    this.judged_id = null;
    this.armed = "";
    this.asked = null;
    this.acting = Promise.resolve();
    this.numActing = 0;
    this.message = { text: "", level: "OK", until_ms: 0 };
    this.prompt = new PromptForm(this.find("prompt"));
    this.sounds = new Sounds(this.find("sounds"));
    this.reset = new ResetTimer(() => { if (this.find("arm_again").checked) this.act("arm"); });
    this.pedal = new Pedal(this.find("pedal"), { taken: (key) => this.hotkeys.has(key), say: (text, level) => this.say(text, level) });
    // Letters go to a field, and press a button.
    const others = [...root.querySelectorAll("[data-key]:not([data-action], [name=outcome])")];
    this.hotkeys = new Map([
      ...others.map((one) => [one.dataset.key, () => (one.type === "button" ? one.closest("[hidden]") || one.click() : one.focus())]),
      ...this.buttons.map((button) => [button.dataset.key, () => this.act(button.dataset.action)]),
      ...this.outcomes.map((outcome) => [outcome.dataset.key, () => this.choose(outcome)]),
      ["k", () => this.reset.end()],
      ["?", () => this.help()],
    ].filter(([key]) => key));
    this.listen();
    this.enable();
  }

  listen() {
    for (const button of this.buttons) {
      if (button.type === "button") button.addEventListener("click", () => this.act(button.dataset.action));
    }
    for (const outcome of this.outcomes) outcome.addEventListener("change", () => this.judge());
    this.find("skip_reset").addEventListener("click", () => this.reset.end());
    this.find("show_keys").addEventListener("click", () => this.help());
    this.find("arm_again").checked = kept("arm_again") === "yes";
    this.find("arm_again").addEventListener("change", (event) => keep("arm_again", event.target.checked ? "yes" : "no"));
    document.addEventListener("keydown", (event) => this.onKey(event));
    const form = this.find("prompt");
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.act("arm");
    });
    for (const kind of ["input", "change"]) form.addEventListener(kind, () => this.enable());
    setInterval(() => this.tick(), 100);
  }

  onKey(event) {
    if (this.pedal.isLearning) {
      event.preventDefault();
      this.pedal.take(event);
      return;
    }
    const { target } = event;
    const isField = target instanceof HTMLSelectElement || target instanceof HTMLInputElement;
    const isTyping = target instanceof HTMLInputElement && !["checkbox", "radio"].includes(target.type);
    if (isField && event.key === "Escape") target.blur();
    if (event.repeat || event.ctrlKey || event.metaKey || event.altKey) return;
    if (this.pedal.matches(event) && !(isTyping && event.key.length === 1)) {
      event.preventDefault();
      if (!this.find("keys").open) this.step();
      return;
    }
    const run = isTyping ? null : this.hotkeys.get(keyOf(event));
    if (!run || (this.find("keys").open && event.key !== "?")) return;
    // Also where the action is not possible now: a letter must not choose another entry of a list.
    event.preventDefault();
    run();
  }

  choose(outcome) {
    if (this.recorder?.state !== "checking") return;
    outcome.checked = true;
    this.judge();
  }

  // The next sensible action, for a pedal; one that bounces does not record and stop at once.
  step() {
    if (this.numActing > 0) return;
    const action = nextStep({ state: this.recorder?.state, judged: this.outcome() !== undefined, changed: this.changed() });
    if (action === "judge" || action === null || !this.allows(action)) this.sounds.play("problem");
    else this.act(action);
  }

  help() {
    const dialog = this.find("keys");
    if (dialog.open) {
      dialog.close();
      return;
    }
    setText(this.find("pedal_key"), this.pedal.name || "none");
    dialog.showModal();
  }

  allows(action) {
    return action === "session" ? (this.recorder?.session ?? null) !== null : (this.recorder?.actions ?? []).includes(action);
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

  // Whether the fields say something else than the take that is armed.
  changed() {
    const armed = this.recorder?.state === "armed" ? this.recorder.prompt : null;
    return armed !== null && armed !== undefined && this.prompt.differs(armed);
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
    if (action === "arm") return this.prompt.read();
    // Named, so that a page that is behind cannot act on another take than the one it shows.
    const isOfTake = !["record", "session"].includes(action) && this.recorder.recording_id;
    const take = isOfTake ? { recording_id: this.recorder.recording_id } : {};
    if (action === "save") return { ...take, success: this.outcome(), accept_incomplete: !this.recorder.complete };
    return take;
  }

  ready(action) {
    if (action === "record" && this.changed()) return false;
    if (action === "save" && this.outcome() === undefined) return false;
    if (action in QUESTIONS) return this.confirmed(action, QUESTIONS[action]);
    if (action === "save" && !this.recorder.complete) return this.confirmed(action, "This take is incomplete. Save it anyway?");
    return action !== "arm" || this.find("prompt").reportValidity();
  }

  // One action after the other: a key that is pressed before the last answer came is not lost.
  act(action) {
    this.numActing += 1;
    this.acting = this.acting.then(() => this.perform(action)).finally(() => { this.numActing -= 1; });
  }

  async perform(action) {
    if (!this.allows(action) || !this.ready(action)) {
      this.tick();
      return;
    }
    const body = this.body(action);
    // Keys work at once after arming from a field.
    if (action === "arm") document.activeElement?.blur();
    try {
      const data = await post(`/v1/recorder/${action}`, body);
      this.say("", "OK");
      this.show(data, this.level);
      if (action === "session") this.prompt.forget();
      if (action === "save") this.reset.start(data.recording_id, this.prompt.reset_s);
    } catch (error) {
      this.fail(error.cause ? error.message : `The dashboard did not answer: ${error.message}`);
    }
    this.reset.tick();
  }

  fail(text) {
    this.say(text, "ERROR");
    this.sounds.play("problem");
  }

  say(text, level, lasts_ms = Infinity) {
    this.asked = null;
    this.message = { text, level, until_ms: performance.now() + lasts_ms };
    this.tick();
  }

  // What the operator has to do next, while nothing else is to be said.
  hint() {
    const pedal = this.pedal.key === null ? "" : " or pedal";
    if (this.changed()) return `The fields changed since this take was armed: arm again (A${pedal}).`;
    const state = this.recorder?.state;
    if (state === "checking" && this.outcome() === undefined) return "How did this take end? Y, N or U";
    if (this.reset.running) return "Reset the scene.";
    const next = { unknown: "No connection to this station: see Devices, below.", idle: "Choose a task, then arm: A", armed: "Record: R", recording: "Stop: S", checking: "Save: V", saved: "Next take, arm: A", discarded: "Next take, arm: A" };
    return next[state] ? next[state] + (state === "unknown" ? "" : pedal) : "";
  }

  show(recorder, level) {
    const before = this.recorder?.state;
    const wasIll = this.level === "ERROR";
    this.recorder = recorder;
    this.level = level;
    this.received_ms = performance.now();
    for (const id of ["recorder_state", "stage"]) this.find(id).dataset.state = recorder.state;
    setText(this.find("recorder_state"), recorder.state === "unknown" ? "no station" : recorder.state);
    for (const field of ["operator", "consent"]) this.find(field).required = recorder.needs_consent ?? false;
    this.reset.keep(recorder);
    this.forgetOutcome(recorder);
    this.takePrompt(recorder);
    this.showVerdict(recorder);
    if (before !== recorder.state) {
      this.say("", "OK");
      this.sound(before, recorder);
    } else if (recorder.state === "recording" && level === "ERROR" && !wasIll) {
      this.sounds.play("problem");
    }
    this.enable();
    this.tick();
  }

  sound(before, recorder) {
    const isLost = before === "recording" && recorder.state === "unknown";
    const isBad = recorder.state === "checking" && !recorder.complete;
    const name = isLost || isBad ? "problem" : SOUNDS[recorder.state];
    if (name && before !== undefined) this.sounds.play(name);
  }

  showLast(take) {
    const line = this.find("last_take");
    line.hidden = !take;
    line.dataset.level = take?.level ?? "OK";
    line.dataset.stage = take?.stage ?? "";
    const link = this.find("last_take_link");
    setText(link, take?.recording_id ?? "");
    if (take?.player) link.href = pagePath(`/episodes/${take.player}`);
    else link.removeAttribute("href");
    setText(this.find("last_take_text"), lastTakeWords(take));
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
    if (armed !== this.armed && armed !== "" && recorder.prompt) this.prompt.write(recorder.prompt);
    this.armed = armed;
  }

  showVerdict(recorder) {
    const isJudged = ["checking", "saved"].includes(recorder.state);
    this.find("verdict").hidden = !isJudged;
    if (!isJudged) return;
    const { word, note, cause, advice } = verdict(recorder);
    this.find("verdict").dataset.level = recorder.level;
    setText(this.find("verdict_word"), word);
    setText(this.find("verdict_cause"), cause);
    setText(this.find("verdict_advice"), advice);
    setText(this.find("recorder_note"), note);
    const list = this.find("recorder_problem_list");
    this.find("recorder_problems").classList.toggle("plain", recorder.problems.length === 0);
    if (recorder.recording_id !== this.verdict_id) this.find("recorder_problems").open = false;
    this.verdict_id = recorder.recording_id;
    showChildren(list, recorder.problems.map((problem) => element("li", {}, problem)));
  }

  enable() {
    const blocked = { record: this.changed(), save: this.outcome() === undefined };
    for (const button of this.buttons) button.disabled = !this.allows(button.dataset.action) || (blocked[button.dataset.action] ?? false);
    const state = this.recorder?.state;
    this.find("outcome").disabled = state !== "checking";
    this.prompt.enable(!["recording", "checking"].includes(state));
    this.showCount();
  }

  showCount() {
    const { task, operator, consent } = this.prompt.read();
    const saved = numSaved(this.recorder?.session, task, operator);
    const { goal } = this.prompt;
    const box = this.find("count");
    box.dataset.level = goal > 0 && saved >= goal ? "OK" : "";
    setText(this.find("num_saved"), goal > 0 ? `${saved} / ${goal}` : String(saved));
    const reached = box.dataset.level === "OK" ? "goal reached" : "saved";
    setText(this.find("count_of"), `${reached} · ${task || "no task"} · ${operator ?? "no operator"}${consent ? ", consent given" : ""} · since ${date(this.recorder?.session?.started_at, "minute")}`);
  }

  tick() {
    this.reset.tick();
    const lasts = performance.now() < this.message.until_ms && this.message.text !== "";
    const message = this.find("recorder_message");
    message.dataset.level = lasts ? this.message.level : "";
    setText(message, lasts ? this.message.text : this.hint());
    this.find("outcome").classList.toggle("wanted", this.recorder?.state === "checking" && this.outcome() === undefined);
    this.find("reset").hidden = !this.reset.running;
    setText(this.find("reset_left"), `${this.reset.left_s ?? 0} s`);
    if (!this.recorder) return;
    const running_s = this.recorder.state === "recording" ? (performance.now() - this.received_ms) / 1000 : 0;
    setText(this.find("recorder_clock"), stopwatch((this.recorder.elapsed_s ?? 0) + running_s));
  }
}
