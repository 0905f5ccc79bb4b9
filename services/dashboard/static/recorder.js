// Recorder panel: buttons, one-key shortcuts and a pedal → POST /v1/recorder/ACTION; what is allowed follows the state.

import { element, find, isModified, keep, kept, onClick, onSubmit, say, setText, showChildren } from "./dom.js";
import { date, stopwatch } from "./format.js";
import { pagePath, post } from "./requests.js";
import { Sounds } from "./sounds.js";

const OTHER = "";
const KEPT_PROMPT = "prompt";

// A list with "other", which shows a text field in its place of choice.
class Choice {
  constructor(select, input) {
    Object.assign(this, { select, input });
    select.addEventListener("change", () => {
      this.show();
      if (this.isOther) input.focus();
    });
  }

  get isOther() {
    return this.select.value === OTHER;
  }

  get value() {
    return (this.isOther ? this.input.value : this.select.value).trim();
  }

  set value(text) {
    const isListed = [...this.select.options].some((option) => option.value === text);
    this.select.value = isListed ? text : OTHER;
    this.input.value = text;
    this.show();
  }

  show() {
    // Free text begins with what was chosen before: most of it often stays.
    if (!this.isOther) this.input.value = this.select.value;
    this.input.parentElement.hidden = !this.isOther;
    this.input.required = this.isOther;
  }
}

// Fields of the next take: task and instruction from the list or as free text, domain, operator, consent.
class PromptForm {
  constructor(form) {
    this.form = form;
    this.find = (id) => form.querySelector(`#${id}`);
    this.task = new Choice(this.find("task_choice"), this.find("task"));
    this.instruction = new Choice(this.find("instruction_choice"), this.find("instruction"));
    this.find("task_choice").addEventListener("change", () => this.listInstructions());
    // Consent is one person's: another operator is asked again.
    this.find("operator").addEventListener("input", () => { this.find("consent").checked = false; });
    this.listInstructions();
    this.task.show();
    const before = kept(KEPT_PROMPT, "sessionStorage");
    if (before) this.write(JSON.parse(before));
    for (const kind of ["input", "change"]) form.addEventListener(kind, () => this.keep());
  }

  // For this tab, so that a page that is loaded anew asks for nothing twice.
  keep() {
    keep(KEPT_PROMPT, JSON.stringify(this.read()), "sessionStorage");
  }

  // The chosen task's option; that of "other" has no instructions.
  get listed() {
    return this.find("task_choice").selectedOptions[0];
  }

  get goal() {
    return Number(this.listed.dataset.goal ?? this.form.dataset.goal);
  }

  get reset_s() {
    return Number(this.listed.dataset.resetS ?? this.form.dataset.resetS);
  }

  listInstructions() {
    const instructions = JSON.parse(this.listed.dataset.instructions ?? "[]");
    const options = instructions.map((text) => element("option", { value: text }, text));
    this.instruction.select.replaceChildren(...options, element("option", { value: OTHER }, "Other instruction …"));
    this.instruction.show();
  }

  read() {
    return { task: this.task.value, instruction: this.instruction.value, domain: this.find("domain").value,
      operator: this.find("operator").value.trim() || null, consent: this.find("consent").checked };
  }

  write(prompt) {
    this.task.value = prompt.task;
    this.listInstructions();
    this.instruction.value = prompt.instruction;
    this.find("domain").value = prompt.domain;
    this.find("operator").value = prompt.operator ?? "";
    this.find("consent").checked = prompt.consent;
    this.keep();
  }

  // Who is recorded is asked once a session.
  forget() {
    this.write({ ...this.read(), operator: null, consent: false });
  }

  differs(prompt) {
    const fields = this.read();
    return Object.keys(fields).some((name) => fields[name] !== (prompt[name] ?? null));
  }

  enable(isEnabled) {
    // A disabled field that keeps the focus would swallow keys.
    if (!isEnabled && this.form.contains(document.activeElement)) document.activeElement.blur();
    for (const field of this.form.elements) if (field.form === this.form && field.tagName !== "BUTTON") field.disabled = !isEnabled;
  }
}

// Of the Latin letter at this place where another alphabet is typed.
function keyOf(event) {
  if (event.key.length === 1 && event.key > "\u007f" && event.code.startsWith("Key")) return event.code.slice(3).toLowerCase();
  return event.key.toLowerCase();
}

const NEXT = { idle: "arm", armed: "record", recording: "stop", saved: "arm", discarded: "arm" };

const STAGES = {
  saved: "saved at the station, not uploaded", uploading: "uploading", refused: "refused by the store", stored: "stored",
  aligning: "aligning", aligned: "aligned", failed: "not aligned",
};
const KEPT = "reset_timer";

// Countdown for resetting the scene after a saved take; it goes on when the page is loaded anew.
class ResetTimer {
  constructor(onEnd) {
    this.onEnd = onEnd;
    this.running = JSON.parse(kept(KEPT, "sessionStorage"));
  }

  start(recording_id, length_s) {
    this.running = { recording_id, ends_ms: Date.now() + 1000 * length_s };
    keep(KEPT, JSON.stringify(this.running), "sessionStorage");
    this.tick();
  }

  cancel() {
    this.running = null;
    keep(KEPT, null, "sessionStorage");
  }

  end() {
    if (!this.running) return;
    this.cancel();
    this.onEnd();
  }

  // Ends with the take that it belongs to: somebody armed the next one.
  keep(recorder) {
    if (this.running && recorder.state !== "unknown" && (recorder.state !== "saved" || recorder.recording_id !== this.running.recording_id)) this.cancel();
  }

  get left_s() {
    return this.running ? Math.max(0, Math.ceil((this.running.ends_ms - Date.now()) / 1000)) : null;
  }

  tick() {
    if (this.running && Date.now() >= this.running.ends_ms) this.end();
  }
}

const NOT_FOR_PEDALS = new Set(["escape", "tab", "shift", "control", "alt", "meta", "capslock", "arrowup", "arrowdown", "arrowleft", "arrowright"]);

// A foot pedal that sends one key, learnt by pressing it.
class Pedal {
  constructor(button, { taken, say }) {
    Object.assign(this, { button, taken, say, isLearning: false, key: kept("pedal") });
    button.addEventListener("click", () => this.learn());
    this.show();
  }

  learn() {
    this.isLearning = true;
    this.button.blur();
    this.say("Press your pedal now. Esc keeps things as they are, Delete forgets the pedal.", "WARN");
    this.show();
  }

  // A key while the pedal is being learnt.
  take(event) {
    const key = event.key.toLowerCase();
    if (["shift", "control", "alt", "meta"].includes(key)) return;
    if (key !== "escape" && key !== "delete" && (this.taken(key) || NOT_FOR_PEDALS.has(key))) {
      this.say(`${keyName(key)} has another meaning on this page: set the pedal to another key, such as F13 or B, and press it.`, "ERROR");
      return;
    }
    this.isLearning = false;
    if (key !== "escape") {
      this.key = key === "delete" ? null : key;
      keep("pedal", this.key);
    }
    this.say(this.key && key !== "escape" ? `Pedal: ${keyName(this.key)}. Each press is the next step: arm, record, stop, save.` : "", "OK");
    this.show();
  }

  matches(event) {
    return this.key !== null && event.key.toLowerCase() === this.key;
  }

  get name() {
    return this.key === null ? "" : keyName(this.key);
  }

  show() {
    this.button.textContent = this.isLearning ? "Press your pedal now" : `Pedal: ${this.name || "none"}`;
  }
}

function keyName(key) {
  if (key === " ") return "Space";
  return key.length === 1 ? key.toUpperCase() : key[0].toUpperCase() + key.slice(1);
}

const CONFIRM_MS = 3000;
const QUESTIONS = {
  discard: "Discard this take?",
  rerecord: "Discard this take and arm the same task again?",
  session: "Count the saved takes from zero?",
};
const SOUNDS = { recording: "start", checking: "stop", saved: "saved" };

export class RecorderPanel {
  constructor(root) {
    this.buttons = [...root.querySelectorAll("button[data-action]")];
    this.outcomes = [...root.querySelectorAll("input[name=outcome]")];
    Object.assign(this, { recorder: null, level: "STALE", received_ms: 0, judged_id: null, armed: "", question: null });
    Object.assign(this, { acting: Promise.resolve(), numActing: 0, message: { text: "", level: "OK", until_ms: 0 } });
    this.prompt = new PromptForm(find("prompt"));
    this.sounds = new Sounds(find("sounds"));
    this.reset = new ResetTimer(() => { if (find("arm_again").checked) this.act("arm"); });
    this.pedal = new Pedal(find("pedal"), { taken: (key) => this.hotkeys.has(key), say: (text, level) => this.say(text, level) });
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
    for (const one of this.buttons) if (one.type === "button") one.addEventListener("click", () => this.act(one.dataset.action));
    for (const outcome of this.outcomes) outcome.addEventListener("change", () => this.judge());
    onClick({ skip_reset: () => this.reset.end(), show_keys: () => this.help() });
    find("arm_again").checked = kept("arm_again") === "yes";
    find("arm_again").addEventListener("change", (event) => keep("arm_again", event.target.checked ? "yes" : "no"));
    document.addEventListener("keydown", (event) => this.onKey(event));
    onSubmit(find("prompt"), () => this.act("arm"));
    for (const kind of ["input", "change"]) find("prompt").addEventListener(kind, () => this.enable());
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
    if (event.repeat || isModified(event)) return;
    if (this.pedal.matches(event) && !(isTyping && event.key.length === 1)) {
      event.preventDefault();
      if (!find("keys").open) this.step();
      return;
    }
    const run = isTyping ? null : this.hotkeys.get(keyOf(event));
    if (!run || (find("keys").open && event.key !== "?")) return;
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
    const state = this.recorder?.state;
    const action = state === "checking" && this.outcome() !== undefined ? "save" : this.changed() ? "arm" : NEXT[state];
    if (action && this.allows(action)) this.act(action);
    else this.sounds.play("problem");
  }

  help() {
    setText(find("pedal_key"), this.pedal.name || "none");
    find("keys")[find("keys").open ? "close" : "showModal"]();
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
    const isConfirmed = this.question === action && now_ms < this.message.until_ms;
    this.question = null;
    if (isConfirmed) return true;
    this.say(`${question} Once more within three seconds to do it.`, "WARN", CONFIRM_MS);
    this.question = action;
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
    return action !== "arm" || find("prompt").reportValidity();
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
      this.say(error.message, "ERROR");
      this.sounds.play("problem");
    }
    this.reset.tick();
  }

  say(text, level, lasts_ms = Infinity) {
    this.question = null;
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
    for (const id of ["recorder_state", "stage"]) find(id).dataset.state = recorder.state;
    setText(find("recorder_state"), recorder.state === "unknown" ? "no station" : recorder.state);
    for (const field of ["operator", "consent"]) find(field).required = recorder.needs_consent ?? false;
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
    const line = find("last_take");
    line.hidden = !take;
    line.dataset.level = take?.level ?? "OK";
    line.dataset.stage = take?.stage ?? "";
    const link = find("last_take_link");
    setText(link, take?.recording_id ?? "");
    if (take?.player) link.href = pagePath(`/episodes/${take.player}`);
    else link.removeAttribute("href");
    setText(find("last_take_text"), take ? [STAGES[take.stage] ?? take.stage, take.reason].filter(Boolean).join(" · ") : "");
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
    find("verdict").hidden = !isJudged;
    if (!isJudged) return;
    const counted = recorder.num_findings ?? 0;
    find("verdict").dataset.level = recorder.level;
    setText(find("verdict_word"), !recorder.complete ? "Incomplete" : counted ? "Complete, with warnings" : "Complete");
    setText(find("verdict_cause"), recorder.cause ?? "");
    setText(find("verdict_advice"), recorder.advice ?? "");
    setText(find("recorder_note"), [recorder.recording_id, counted === 1 ? "1 finding" : `${counted || "no"} findings`].filter(Boolean).join(" · "));
    find("recorder_problems").classList.toggle("plain", recorder.problems.length === 0);
    if (recorder.recording_id !== this.verdict_id) find("recorder_problems").open = false;
    this.verdict_id = recorder.recording_id;
    showChildren(find("recorder_problem_list"), recorder.problems.map((problem) => element("li", {}, problem)));
  }

  enable() {
    const blocked = { record: this.changed(), save: this.outcome() === undefined };
    for (const button of this.buttons) button.disabled = !this.allows(button.dataset.action) || (blocked[button.dataset.action] ?? false);
    const state = this.recorder?.state;
    find("outcome").disabled = state !== "checking";
    this.prompt.enable(!["recording", "checking"].includes(state));
    this.showCount();
  }

  showCount() {
    const { task, operator, consent } = this.prompt.read();
    const saved = this.recorder?.session?.saved?.find((item) => item.task === task && (item.operator ?? null) === operator)?.num_saved ?? 0;
    const { goal } = this.prompt;
    const box = find("count");
    box.dataset.level = goal > 0 && saved >= goal ? "OK" : "";
    setText(find("num_saved"), goal > 0 ? `${saved} / ${goal}` : String(saved));
    const reached = box.dataset.level === "OK" ? "goal reached" : "saved";
    setText(find("count_of"), `${reached} · ${task || "no task"} · ${operator ?? "no operator"}${consent ? ", consent given" : ""} · since ${date(this.recorder?.session?.started_at, "minute")}`);
  }

  tick() {
    this.reset.tick();
    const lasts = performance.now() < this.message.until_ms && this.message.text !== "";
    say(find("recorder_message"), lasts ? this.message.text : this.hint(), lasts ? this.message.level : null);
    find("outcome").classList.toggle("wanted", this.recorder?.state === "checking" && this.outcome() === undefined);
    find("reset").hidden = !this.reset.running;
    setText(find("reset_left"), `${this.reset.left_s ?? 0} s`);
    if (!this.recorder) return;
    const running_s = this.recorder.state === "recording" ? (performance.now() - this.received_ms) / 1000 : 0;
    setText(find("recorder_clock"), stopwatch((this.recorder.elapsed_s ?? 0) + running_s));
  }
}
