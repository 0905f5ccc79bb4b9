// Keys, buttons and selection of a page with a grid, by which the list and the review queue are worked.

import { find, say as note, setText } from "../dom.js";
import { isFree } from "./grid.js";

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
