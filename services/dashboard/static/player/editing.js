// Edits in the player: a selection on the timeline, notes on it, "Trim to selection" and "Relabel".
// Each edit is first shown as the store would do it, with the command that does the same.

import { attempt, button, element, find, isModified, keep, kept, onClick, quote, setText } from "../dom.js";
import { pagePath, post } from "../requests.js";
import { fetchFacts } from "./item.js";
import { after, secondsText, stampOf } from "./times.js";

// Steps of an episode at or after the start of a span and before its end: [first, stop]. The last step
// belongs to a span that ends on it, since nothing can be selected after it.
export function stepsOf([from_ns, to_ns], { num_steps, model_rate_hz }) {
  const step = (t_ns) => Math.min(Math.max(Math.ceil((t_ns * model_rate_hz) / 1e9 - 1e-4), 0), num_steps);
  const isWhole = (to_ns * model_rate_hz) / 1e9 > num_steps - 1 - 1e-4;
  return [step(from_ns), isWhole ? num_steps : step(to_ns)];
}

function command(name, kind, ids, options) {
  const words = Object.entries(options).flatMap(([key, value]) => (value === undefined || value === null || value === false || value === "" ? [] : value === true ? [`--${key}`] : [`--${key}`, ...[value].flat().map((one) => quote(String(one)))]));
  return ["dextouch store", name, ...ids, ...(kind === "recording" ? ["--kind recording"] : []), ...words].join(" ");
}

export function trimCommand(id, [first, stop], { outcome, keep }) {
  return command("trim", "episode", [id], { steps: [first, stop], outcome, keep });
}

export function relabelCommand({ kind, id }, { task, instruction, operator, outcome, keep }) {
  return command("relabel", kind, [id], { task, instruction, operator, outcome, keep });
}

function spanText([from_ns, to_ns]) {
  const ms = (t_ns) => secondsText(Math.round(t_ns / 1e6) * 1e6);
  return from_ns === to_ns ? `${ms(from_ns)} s` : `${ms(from_ns)} – ${ms(to_ns)} s`;
}

const STORE = "/v1/episode_store";
const LABELS = ["task", "instruction", "operator"];
const NOTE_COLOURS = 4;

export class Editing {
  constructor(player) {
    Object.assign(this, { player, item: player.item, selection: null, notes: [], numPreviews: 0, path: `${STORE}/notes/${player.item.path}` });
    const { kind, num_steps } = this.item.about;
    find("open_trim").hidden = kind !== "episode" || !num_steps;
    onClick({
      select_start: () => this.mark(0), select_stop: () => this.mark(1), select_none: () => this.select(null),
      open_note: () => this.openNote(), open_trim: () => this.openTrim(), open_relabel: () => this.openRelabel(),
    });
    this.dialog = find("edit_dialog");
    this.form = find("edit_form");
    this.fields = this.form.elements;
    for (const one of this.dialog.querySelectorAll("[data-close]")) one.addEventListener("click", () => this.dialog.close());
    document.addEventListener("keydown", (event) => this.pressed(event));
    this.select(null);
    this.load();
  }

  pressed(event) {
    if (isModified(event) || this.dialog.open || event.target.closest("input, select, textarea")) return;
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

  load() {
    return attempt(find("notes_failure"), async () => this.show(await fetchFacts(this.path.slice(STORE.length))), "Notes: ");
  }

  show({ notes }) {
    this.notes = notes.map((note) => ({ note, span: [note.start_ns, note.stop_ns].map((stamp) => after(stamp, this.item.zero)) }));
    find("notes").hidden = !notes.length;
    setText(find("notes_failure"), "");
    find("note_rows").replaceChildren(...this.notes.map(({ note, span }) => {
      const jump = button(spanText(span), () => {
        this.select(span[0] < span[1] ? span : null);
        this.player.seek(span[0]);
      }, { class: "plain", title: "Go there" });
      const remove = button("×", () => attempt(find("notes_failure"), async () => {
        await post(`${this.path}/remove`, { number: note.number });
        await this.load();
      }), { class: "plain", title: "Remove this note", "aria-label": `remove note ${note.number}` });
      return element("li", {}, jump, element("span", { class: "note_text" }, note.text), element("span", { class: "quiet" }, note.author ?? ""), remove);
    }));
    this.draw();
  }

  openNote() {
    const at = this.player.clock.t_ns;
    const span = this.selection ?? [at, at];
    const { text, author } = this.fields;
    this.open("note", { title: "Note", words: spanText(span), verb: "Add" }, async () => {
      keep("reviewer", author.value);
      const [start_ns, stop_ns] = span.map((t_ns) => stampOf(t_ns, this.item.zero));
      await post(this.path, { start_ns, stop_ns, text: text.value, author: author.value.trim() || null });
      await this.load();
      return () => this.dialog.close();
    });
    author.value = kept("reviewer") ?? "";
    text.focus();
  }

  // Edits

  openTrim() {
    if (!this.selection) return;
    const { id } = this.item.about;
    const [first, stop] = stepsOf(this.selection, this.item.about);
    this.openEdit("trim", { title: "Trim to selection", words: `${spanText(this.selection)}: steps ${first} to ${stop - 1}` }, {
      command: (how) => trimCommand(id, [first, stop], how),
      send: (how) => post(`${STORE}/episodes/${encodeURIComponent(id)}/trim`, { first_step: first, stop_step: stop, ...how }),
    });
  }

  openRelabel() {
    const { about } = this.item;
    const changed = () => Object.fromEntries(LABELS.map((name) => [name, this.fields[name].value.trim()]).filter(([name, text]) => text !== (about[name] ?? "")));
    const fill = () => LABELS.forEach((name) => { this.fields[name].value = about[name] ?? ""; });
    this.openEdit("relabel", { title: "Relabel", words: "", fill }, {
      command: (how) => relabelCommand(about, { ...changed(), ...how }),
      send: async (how) => {
        const { edited, refused } = await post(`${STORE}/catalog/relabel`, { items: [{ kind: about.kind, id: about.id }], ...changed(), ...how });
        if (refused.length) throw new Error(refused[0].reason);
        return edited[0];
      },
    });
  }

  openEdit(kind, about, { command, send }) {
    const { outcome, keep } = this.fields;
    const how = (dry_run) => ({ outcome: outcome.value || null, keep: keep.checked, dry_run });
    const apply = this.open(kind, { ...about, verb: about.title }, async () => {
      const result = await send(how(false));
      return () => this.showResult(result);
    });
    this.form.onchange = async () => {
      const number = (this.numPreviews += 1);
      apply.disabled = true;
      setText(find("edit_command"), command({ outcome: outcome.value, keep: keep.checked }));
      const result = await send(how(true)).catch((error) => error);
      // Of another dialog, or of fields that changed since.
      if (number !== this.numPreviews) return;
      const isRefused = result instanceof Error;
      apply.disabled = isRefused;
      const lines = isRefused ? [result.message] : [`Becomes ${result.id}; the source is then ${result.source_is}.`, ...result.messages];
      find("edit_preview").replaceChildren(...lines.map((line) => element("p", {}, line)));
    };
    this.form.onchange();
  }

  showResult({ kind, id, source_id, source_is }) {
    this.form.hidden = true;
    find("edit_done").hidden = false;
    setText(find("edit_result"), id);
    find("edit_result").href = pagePath(`/episodes/${kind}/${encodeURIComponent(id)}`);
    setText(find("edit_undo"), `To undo this, delete ${id}${source_is === "in the trash" ? ` and restore ${source_id} from the trash` : ""}.`);
  }

  // Show the parts of the form that are of this kind; gives the button that applies it. `act` gives what shows its result.
  open(kind, { title, words, verb, fill = () => {} }, act) {
    this.player.clock.pause();
    this.form.reset();
    fill();
    const apply = this.form.querySelector(".primary");
    for (const part of this.form.querySelectorAll("fieldset")) part.hidden = part.disabled = !part.dataset.of.split(" ").includes(kind);
    this.form.hidden = false;
    find("edit_failure").hidden = find("edit_done").hidden = true;
    setText(find("edit_title"), title);
    setText(find("edit_words"), words);
    setText(apply, verb);
    apply.disabled = false;
    find("edit_preview").replaceChildren();
    this.numPreviews += 1;
    this.form.onchange = null;
    const submit = async (event) => {
      event.preventDefault();
      apply.disabled = true;
      this.numPreviews += 1;
      const fail = (error) => () => {
        find("edit_failure").hidden = false;
        setText(find("edit_failure"), error.message);
      };
      const showEnd = await act().catch(fail);
      // The dialogs share one form: this one may show another by now.
      if (this.form.onsubmit !== submit) return;
      showEnd();
      apply.disabled = false;
    };
    this.form.onsubmit = submit;
    this.dialog.showModal();
    return apply;
  }
}
