// Services and newest takes → short lists.

import { element, levelBadge, showChildren, why } from "./dom.js";
import { ask, pagePath } from "./session.js";

export function showServices(list, services) {
  showChildren(list, services.map((service) => element("li", { title: service.message },
    levelBadge(service.level), element("span", {}, service.name.replaceAll("_", " ")),
    service.level === "OK" ? null : element("span", { class: "quiet" }, service.message))));
}

const CONSENT = new Map([[true, "consent given"], [false, "no consent"]]);

function takeRow(take) {
  return element("tr", {},
    element("td", { class: "quiet" }, take.kind, why(take.domain)),
    element("td", { class: "name" }, element("a", { href: pagePath(`/episodes/${take.kind}/${encodeURIComponent(take.name)}`) }, take.name), why(take.size), why(take.clocks)),
    element("td", {}, take.task),
    element("td", {}, take.operator ?? "–", why(CONSENT.get(take.consent))),
    element("td", {}, take.outcome));
}

// A take that the store refused waits at the station until somebody has it sent again.
function refusedItem(take, say) {
  const button = element("button", { type: "button" }, "Send again");
  button.addEventListener("click", async () => {
    button.disabled = true;
    try {
      const answer = await ask(`/v1/uploads/${encodeURIComponent(take.recording_id)}/retry`, { method: "POST" });
      if (!answer.ok) say((await answer.json()).detail ?? `refused (${answer.status})`);
    } catch (error) {
      say(`The dashboard did not answer: ${error.message}`);
    } finally {
      button.disabled = false;
    }
  });
  return element("li", {}, element("span", {}, element("strong", {}, take.recording_id), why(take.error)), button);
}

export function showRefused(list, refused) {
  // Rebuilt only when it changes, so that a click does not fall between two buttons.
  const now = JSON.stringify(refused);
  if (list.dataset.shown === now) return;
  list.dataset.shown = now;
  const note = element("li", { class: "note", "data-level": "ERROR", role: "alert" });
  const items = refused.map((take) => refusedItem(take, (text) => { note.textContent = text; }));
  list.replaceChildren(...(items.length ? [...items, note] : []));
}

export function showTakes(body, { takes, note }) {
  const empty = element("tr", {}, element("td", { colspan: 5, class: "free" }, note));
  showChildren(body, takes.length ? takes.map(takeRow) : [empty]);
}
