// Rows of a table that are walked and selected by keys; rows keep their place while their content changes.

import { find, placeChildren, say as note, setText } from "../dom.js";

export class Grid {
  // `onChange` is called when the selection or the row in focus changes, `onOpen` with the key of a row.
  constructor(body, { onChange, onOpen }) {
    Object.assign(this, { body, onChange, onOpen, keys: [], rows: new Map(), selected: new Set(), active: null });
    body.addEventListener("click", (event) => this.onClick(event));
    body.addEventListener("focusin", (event) => this.activate(event.target.closest("tr")?.dataset.key ?? null));
    body.addEventListener("dblclick", (event) => {
      const key = event.target.closest("tr")?.dataset.key;
      if (key && !event.target.closest("a, button, input")) this.onOpen(key);
    });
  }

  // `rows` are {key, state, build}: a row is built anew only when its state changed.
  show(rows) {
    const held = document.activeElement?.closest("tr")?.dataset.key;
    const holds = held !== undefined && this.body.contains(document.activeElement);
    const place = this.keys.indexOf(this.active);
    this.keys = rows.map((row) => row.key);
    for (const key of this.rows.keys()) if (!this.keys.includes(key)) this.rows.delete(key);
    const nodes = rows.map(({ key, state, build }) => {
      const known = this.rows.get(key);
      if (known?.state === state) return known.node;
      const node = build();
      node.dataset.key = key;
      this.rows.set(key, { state, node });
      return node;
    });
    placeChildren(this.body, nodes);
    this.selected = new Set([...this.selected].filter((key) => this.rows.has(key)));
    // The row that went is followed by the one in its place.
    if (!this.rows.has(this.active)) this.active = this.keys[Math.min(Math.max(place, 0), this.keys.length - 1)] ?? null;
    this.mark();
    if (holds && !this.body.contains(document.activeElement)) this.focus();
    this.onChange();
  }

  mark() {
    for (const [key, { node }] of this.rows) {
      node.tabIndex = key === this.active ? 0 : -1;
      node.setAttribute("aria-selected", String(this.selected.has(key)));
      node.classList.toggle("active", key === this.active);
      const box = node.querySelector("input[type=checkbox]");
      if (box) box.checked = this.selected.has(key);
    }
  }

  focus() {
    const node = this.rows.get(this.active)?.node;
    node?.focus({ preventScroll: true });
    node?.scrollIntoView({ block: "nearest" });
  }

  activate(key) {
    if (key === this.active || !this.rows.has(key)) return;
    this.active = key;
    this.mark();
    this.onChange();
  }

  select(keys, isSelected) {
    for (const key of keys) this.selected[isSelected ? "add" : "delete"](key);
    this.mark();
    this.onChange();
  }

  toggle(key) {
    if (this.rows.has(key)) this.select([key], !this.selected.has(key));
  }

  // The selected rows, or the one in focus.
  meant() {
    if (this.selected.size) return this.keys.filter((key) => this.selected.has(key));
    return this.active === null ? [] : [this.active];
  }

  onClick(event) {
    const key = event.target.closest("tr")?.dataset.key;
    if (!key) return;
    this.activate(key);
    if (event.target.matches("input[type=checkbox]")) this.toggle(key);
    else if (!event.target.closest("a, button, input")) this.focus();
  }

  // Whether the key was one of the grid's.
  onKey(event) {
    const place = this.keys.indexOf(this.active);
    const places = { ArrowDown: place + 1, ArrowUp: place - 1, Home: 0, End: this.keys.length - 1 };
    if (event.key in places) {
      const next = this.keys[Math.min(Math.max(places[event.key], 0), this.keys.length - 1)];
      // Without focus, the first arrow shows where it is.
      const isHere = this.body.contains(document.activeElement);
      if (event.shiftKey) this.select([this.active, next].filter((key) => key), true);
      if (isHere || event.shiftKey) this.activate(next);
      this.focus();
    } else if (event.key === " ") {
      this.toggle(this.active);
    } else if (event.key === "Enter") {
      if (this.active !== null) this.onOpen(this.active);
    } else if (event.key === "a" && (event.ctrlKey || event.metaKey)) {
      this.select(this.keys, true);
    } else {
      return false;
    }
    event.preventDefault();
    return true;
  }
}

// Keys that a page may use: not while typing, and not those of a button or link in focus.
function isFree(event) {
  const target = event.target;
  if (event.altKey || target.closest?.("dialog")) return false;
  if (target instanceof HTMLInputElement) return target.type === "checkbox" && event.key !== " ";
  if (target.matches?.("select, textarea")) return false;
  return !(target.closest?.("a, button, summary") && ["Enter", " "].includes(event.key));
}

// `actions` by key, `buttons` as [id, key]; the keys of the grid come first, and Esc leaves a field of `form`.
export function listen(grid, { form, actions, buttons }) {
  document.addEventListener("keydown", (event) => {
    if (event.key === "Escape" && form.contains(event.target)) {
      event.target.blur();
      grid.focus();
    } else if (isFree(event) && !grid.onKey(event) && !event.ctrlKey && !event.metaKey && !event.repeat) {
      const act = actions[event.key.toLowerCase()];
      if (act) {
        event.preventDefault();
        act();
      }
    }
  });
  for (const [id, key] of buttons) find(id).addEventListener("click", () => actions[key]());
  find("pick_all").addEventListener("change", (event) => grid.select(grid.keys, event.target.checked));
}

export function showSelected(grid) {
  setText(find("selected"), grid.selected.size ? `${grid.selected.size} selected` : "none selected: keys act on the focused row");
}

export function say(text, level = "OK") {
  note(find("message"), text, level);
}
