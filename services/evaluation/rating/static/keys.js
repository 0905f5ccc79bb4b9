// What the keys of the rating page do: a rater may give each action another key, which this browser keeps.

import { at } from "./request.js";

const ACTIONS = { play: "Pause or play", back: "Step back", forward: "Step forward", inconsistent: "Physically impossible", cannot: "Cannot judge", save: "Save and next" };
const USUAL = { play: " ", back: "ArrowLeft", forward: "ArrowRight", inconsistent: "i", cannot: "c", save: "Enter" };
for (let digit = 1; digit <= 9; digit += 1) [ACTIONS[digit], USUAL[digit]] = [`Criterion ${digit}`, `${digit}`];
const NAMES = { " ": "Space", ArrowLeft: "←", ArrowRight: "→" };
const KEPT = "dextouch.rating.keys";
let keys = { ...USUAL };
let learning = null;
let numCriteria = 0;
const attempt = (act) => { try { act(); } catch { /* A browser that keeps nothing, or no JSON: these keys last as long as the page. */ } };
attempt(() => {
  for (const [action, key] of Object.entries(JSON.parse(localStorage.getItem(KEPT)))) if (action in USUAL && typeof key === "string") keys[action] = key;
});

// Show the keys in the hints and in the list, with those of the criteria that there are.
export function showKeys(criteria = numCriteria, focused = null) {
  numCriteria = criteria;
  const nameOf = (action) => NAMES[keys[action]] ?? (keys[action].length === 1 ? keys[action].toUpperCase() : keys[action]);
  for (const hint of document.querySelectorAll("kbd[data-action]")) hint.textContent = nameOf(hint.dataset.action);
  const shown = Object.keys(USUAL).filter((action) => !(Number(action) > numCriteria));
  at("key_list").replaceChildren(...shown.map((action) => {
    const button = Object.assign(document.createElement("button"), { type: "button", textContent: `${ACTIONS[action]}: ${action === learning ? "press a key" : nameOf(action)}` });
    button.setAttribute("aria-pressed", `${action === learning}`);
    button.addEventListener("click", () => { learning = action; showKeys(numCriteria, action); });
    return button;
  }));
  if (focused) at("key_list").children[shown.indexOf(focused)].focus();
}

// The action of a pressed key. A key that is being assigned goes to its action, which gives its own to the one that had it.
export function actionOf(event) {
  const pressed = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  if (["Shift", "CapsLock", "Tab"].includes(pressed)) return null;
  const held = Object.keys(keys).find((action) => keys[action] === pressed);
  if (!learning) return event.target.closest("#keys") && ["Enter", " "].includes(pressed) ? null : held;
  if (pressed !== "Escape") {
    if (held) keys[held] = keys[learning];
    keys[learning] = pressed;
    attempt(() => localStorage.setItem(KEPT, JSON.stringify(keys)));
  }
  const learnt = learning;
  learning = null;
  showKeys(numCriteria, learnt);
  return "learned";
}

at("usual").addEventListener("click", () => {
  [keys, learning] = [{ ...USUAL }, null];
  showKeys();
  attempt(() => localStorage.removeItem(KEPT));
});
