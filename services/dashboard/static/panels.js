// Panels of a page can be hidden and enlarged; what was chosen is kept in this browser for each person, station and screen.

import { button, element, keep, kept } from "./dom.js";

const main = document.querySelector("main");
const { person, station, screen } = main.dataset;
const KEY = `panels ${JSON.stringify([person, station, screen])}`;
// What says whether something is recorded or played, and guided runs, stay as they are.
const found = [...main.querySelectorAll(".panel[aria-labelledby]:not(.recorder, #begin, #run)")].map((panel) => [panel.getAttribute("aria-labelledby"), panel]);
const panels = new Map(found.length > 1 ? found : []);
const nameOf = (panel) => panel.querySelector("h2").textContent || panel.id;
const away = element("p", { class: "panels_away quiet", hidden: "" });
let chosen = { hidden: [], enlarged: null };

function show() {
  for (const [id, panel] of panels) {
    panel.classList.toggle("put_away", chosen.hidden.includes(id));
    panel.classList.toggle("enlarged", id === chosen.enlarged);
    panel.querySelector(".panel_tools [data-tool=enlarge]").setAttribute("aria-pressed", String(id === chosen.enlarged));
  }
  // What the page itself hides cannot be brought back.
  const hidden = chosen.hidden.filter((id) => panels.has(id) && !panels.get(id).hidden);
  away.hidden = !hidden.length;
  away.replaceChildren("Hidden panels: ", ...hidden.map((id) => tool(nameOf(panels.get(id)), `Show ${nameOf(panels.get(id))}`, () => choose({ hidden: chosen.hidden.filter((one) => one !== id) }))));
}

function choose(change) {
  chosen = { ...chosen, ...change };
  show();
  keep(KEY, JSON.stringify(chosen));
}

function tool(text, label, act, attributes = {}) {
  return button(text, act, { class: "plain", "aria-label": label, title: label, ...attributes });
}

for (const [id, panel] of panels) {
  const enlarge = tool("⤢", `Enlarge ${nameOf(panel)}`, () => choose({ enlarged: chosen.enlarged === id ? null : id }), { "data-tool": "enlarge" });
  const hide = tool("×", `Hide ${nameOf(panel)}`, () => choose({ hidden: [...chosen.hidden, id], enlarged: chosen.enlarged === id ? null : chosen.enlarged }));
  panel.append(element("div", { class: "panel_tools" }, enlarge, hide));
  new MutationObserver(show).observe(panel, { attributeFilter: ["hidden"] });
}
main.insertBefore(away, main.querySelector(":scope > .deck"));
try {
  const { hidden, enlarged } = JSON.parse(kept(KEY)) ?? chosen;
  if (Array.isArray(hidden)) chosen = { hidden, enlarged };
} catch {
  // What cannot be read is as nothing kept.
}
show();
