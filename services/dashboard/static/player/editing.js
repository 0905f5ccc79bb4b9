// Edits in the player: a selection on the timeline, notes on it, "Trim to selection" and "Relabel".
// Each edit is first shown as the store would do it, with the command that does the same.

import { post } from "../catalog/api.js";
import { element, setText } from "../dom.js";
import { pagePath } from "../session.js";
import { relabelCommand, spanText, stepsOf, trimCommand } from "./edit_spans.js";
import { fetchFacts } from "./item.js";
import { after, stampOf } from "./times.js";

const STORE = "/v1/episode_store";
const OUTCOMES = ["", "keep", "success", "failure", "unknown"];
const NOTE_COLOURS = 4;
const find = (id) => document.getElementById(id);

function field(name, label, input) {
  input.name = name;
  return element("label", {}, `${label} `, input);
}

function choice(options) {
  return element("select", {}, ...options.map((one) => element("option", { value: one }, one || "as it is")));
}

export class Editing {
  constructor(player) {
    this.player = player;
    this.item = player.item;
    this.selection = null;
    this.notes = [];
    this.path = `${STORE}/notes/${this.item.path}`;
    const { kind, num_steps } = this.item.about;
    find("open_trim").hidden = kind !== "episode" || !num_steps;
    const click = (id, act) => find(id).addEventListener("click", act);
    click("select_start", () => this.mark(0));
    click("select_stop", () => this.mark(1));
    click("select_none", () => this.select(null));
    click("open_note", () => this.openNote());
    click("open_trim", () => this.openTrim());
    click("open_relabel", () => this.openRelabel());
    this.dialog = find("edit_dialog");
    this.dialog.addEventListener("close", () => this.dialog.replaceChildren());
    document.addEventListener("keydown", (event) => this.pressed(event));
    this.select(null);
    this.load();
  }

  pressed(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || this.dialog.open || event.target.closest("input, select, textarea")) return;
    const acts = { "[": () => this.mark(0), "]": () => this.mark(1), n: () => this.openNote(), Escape: () => this.select(null) };
    if (!Object.hasOwn(acts, event.key)) return;
    event.preventDefault();
    acts[event.key]();
  }

  // Selection

  mark(end) {
    const { t_ns, start_ns, stop_ns } = this.player.clock;
    const span = [...(this.selection ?? [start_ns, stop_ns])];
    span[end] = t_ns;
    if (span[0] > span[1]) span[1 - end] = t_ns;
    this.select(span);
  }

  select(span) {
    this.selection = span;
    setText(find("selection"), span ? spanText(span) : "nothing selected");
    find("select_none").hidden = find("open_trim").disabled = !span;
    this.draw();
  }

  draw() {
    const marks = this.notes.map(({ span, note }) => ({
      span_ns: span,
      node: element("i", { class: "note_mark", "data-colour": note.number % NOTE_COLOURS, title: `${spanText(span)}: ${note.text}` }),
    }));
    if (this.selection) marks.push({ span_ns: this.selection, node: element("i", { class: "selected" }) });
    this.player.timeline.setMarks(marks);
  }

  // Notes

  async load() {
    try {
      this.show(await fetchFacts(this.path.slice(STORE.length)));
    } catch (error) {
      setText(find("notes_failure"), `Notes: ${error.message}`);
    }
  }

  show({ notes }) {
    this.notes = notes.map((note) => ({ note, span: [note.start_ns, note.stop_ns].map((stamp) => after(stamp, this.item.zero)) }));
    find("notes").hidden = !notes.length;
    setText(find("notes_failure"), "");
    find("note_rows").replaceChildren(...this.notes.map(({ note, span }) => {
      const jump = element("button", { type: "button", class: "plain", title: "Go there" }, spanText(span));
      jump.addEventListener("click", () => {
        this.select(span[0] < span[1] ? span : null);
        this.player.seek(span[0]);
      });
      const remove = element("button", { type: "button", class: "plain", title: "Remove this note", "aria-label": `remove note ${note.number}` }, "×");
      remove.addEventListener("click", async () => {
        try {
          await post(`${this.path}/remove`, { number: note.number });
          await this.load();
        } catch (error) {
          setText(find("notes_failure"), error.message);
        }
      });
      return element("li", {}, jump, element("span", { class: "note_text" }, note.text), element("span", { class: "quiet" }, note.author ?? ""), remove);
    }));
    this.draw();
  }

  openNote() {
    const at = this.player.clock.t_ns;
    const span = this.selection ?? [at, at];
    const text = element("textarea", { rows: 3, maxlength: 1000, required: "" });
    const author = element("input", { maxlength: 128, placeholder: "your pseudonym" });
    author.value = localStorage.getItem("reviewer") ?? "";
    this.open("Note", [element("p", { class: "quiet" }, spanText(span)), field("text", "Text", text), field("author", "Author", author)], "Add", async () => {
      localStorage.setItem("reviewer", author.value);
      const [start_ns, stop_ns] = span.map((t_ns) => stampOf(t_ns, this.item.zero));
      await post(this.path, { start_ns, stop_ns, text: text.value, author: author.value.trim() || null });
      await this.load();
      this.dialog.close();
    });
    text.focus();
  }

  // Edits

  openTrim() {
    if (!this.selection) return;
    const { id } = this.item.about;
    const [first, stop] = stepsOf(this.selection, this.item.about);
    const read = (fields) => ({ outcome: fields.outcome.value, keep: fields.keep.checked });
    this.openEdit("Trim to selection", [element("p", {}, `${spanText(this.selection)}: steps ${first} to ${stop - 1}`)], {
      command: (fields) => trimCommand(id, [first, stop], read(fields)),
      send: async (fields, dry_run) => {
        const { outcome, keep } = read(fields);
        const body = { first_step: first, stop_step: stop, outcome: outcome || null, keep, dry_run };
        return post(`${STORE}/episodes/${encodeURIComponent(id)}/trim`, body);
      },
    });
  }

  openRelabel() {
    const { about } = this.item;
    const inputs = ["task", "instruction", "operator"].map((name) => {
      const input = element(name === "instruction" ? "textarea" : "input", { rows: name === "instruction" ? 2 : null });
      input.value = about[name] ?? "";
      return field(name, name[0].toUpperCase() + name.slice(1), input);
    });
    const read = (fields) => {
      const texts = ["task", "instruction", "operator"].map((name) => [name, fields[name].value.trim()]);
      const changed = texts.filter(([name, text]) => text !== (about[name] ?? "")).map(([name, text]) => [name, text]);
      return { ...Object.fromEntries(changed), outcome: fields.outcome.value, keep: fields.keep.checked };
    };
    this.openEdit("Relabel", inputs, {
      command: (fields) => relabelCommand(about, read(fields)),
      send: async (fields, dry_run) => {
        const { outcome, ...changes } = read(fields);
        const body = { items: [{ kind: about.kind, id: about.id }], ...changes, outcome: outcome || null, dry_run };
        const { edited, refused } = await post(`${STORE}/catalog/relabel`, body);
        if (refused.length) throw new Error(refused[0].reason);
        return edited[0];
      },
    });
  }

  openEdit(title, parts, { command, send }) {
    const preview = element("div", { class: "preview", role: "status" });
    const code = element("code", {});
    const keep = element("input", { type: "checkbox" });
    const kept = element("label", { class: "check" }, keep, "Keep the source, as superseded");
    keep.name = "keep";
    let asked = 0;
    const { form, apply } = this.open(title, [...parts, field("outcome", "Outcome", choice(OUTCOMES)), kept, preview, element("p", { class: "command" }, code)], title, async () => {
      this.showResult(await send(form.elements, false));
    });
    const show = async () => {
      const number = (asked += 1);
      apply.disabled = true;
      setText(code, command(form.elements));
      let lines;
      try {
        const result = await send(form.elements, true);
        lines = [`Becomes ${result.id}; the source is then ${result.source_is}.`, ...result.messages];
        if (number === asked) apply.disabled = false;
      } catch (error) {
        lines = [error.message];
      }
      if (number === asked) preview.replaceChildren(...lines.map((line) => element("p", {}, line)));
    };
    form.addEventListener("change", show);
    show();
  }

  showResult({ kind, id, source_id, source_is }) {
    const link = element("a", { href: pagePath(`/episodes/${kind}/${encodeURIComponent(id)}`), class: "result" }, id);
    const undo = source_is === "in the trash" ? `To undo this, delete ${id} and restore ${source_id} from the trash.` : `To undo this, delete ${id}.`;
    const close = element("button", { type: "button" }, "Close");
    close.addEventListener("click", () => this.dialog.close());
    this.dialog.replaceChildren(element("h2", {}, "Done"), element("p", {}, "The new item is ", link, "."), element("p", { class: "quiet" }, undo), close);
  }

  open(title, parts, verb, act) {
    this.player.clock.pause();
    const failure = element("p", { class: "note", "data-level": "ERROR", role: "alert", hidden: "" });
    const apply = element("button", { class: "primary" }, verb);
    const cancel = element("button", { type: "button" }, "Cancel");
    cancel.addEventListener("click", () => this.dialog.close());
    const form = element("form", { class: "edit_form" }, element("h2", {}, title), ...parts, failure, element("div", { class: "edit_buttons" }, apply, cancel));
    form.addEventListener("submit", async (event) => {
      event.preventDefault();
      apply.disabled = true;
      try {
        await act();
      } catch (error) {
        failure.hidden = false;
        setText(failure, error.message);
      }
      apply.disabled = false;
    });
    this.dialog.replaceChildren(form);
    this.dialog.showModal();
    return { form, apply };
  }
}
