// Fields of the next take: task and instruction from the list or as free text, domain, operator, consent.

import { element, keep, kept } from "./dom.js";

const OTHER = "";
const KEPT = "prompt";

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

export class PromptForm {
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
    const before = kept(KEPT, "sessionStorage");
    if (before) this.write(JSON.parse(before));
    for (const kind of ["input", "change"]) form.addEventListener(kind, () => this.keep());
  }

  // For this tab, so that a page that is loaded anew asks for nothing twice.
  keep() {
    keep(KEPT, JSON.stringify(this.read()), "sessionStorage");
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
