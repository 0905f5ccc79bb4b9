// Services, newest takes and camera thumbnails → short lists.

import { element, levelBadge } from "./dom.js";
import { age } from "./format.js";

export function showServices(list, services) {
  list.replaceChildren(...services.map((service) => element("li", { title: service.message },
    levelBadge(service.level), element("span", {}, service.name),
    service.level === "OK" ? null : element("span", { class: "quiet" }, service.message))));
}

const CONSENT = new Map([[true, "consent given"], [false, "no consent"]]);

function why(text) {
  return text ? element("span", { class: "why" }, text) : null;
}

function takeRow(take) {
  return element("tr", {},
    element("td", { class: "quiet" }, take.kind, why(take.domain)),
    element("td", { class: "name" }, take.name, why(take.size), why(take.clocks)),
    element("td", {}, take.task),
    element("td", {}, take.operator ?? "–", why(CONSENT.get(take.consent))),
    element("td", {}, take.outcome));
}

export function showTakes(body, { takes, note }) {
  const empty = element("tr", {}, element("td", { colspan: 5, class: "free" }, note));
  body.replaceChildren(...(takes.length ? takes.map(takeRow) : [empty]));
}

export function showCameras(section, row, cameras) {
  section.hidden = cameras.length === 0;
  const known = new Map([...row.children].map((figure) => [figure.dataset.name, figure]));
  for (const camera of cameras) {
    const figure = known.get(camera.name) ?? row.appendChild(element("figure", { "data-name": camera.name },
      element("img", { alt: `newest image of ${camera.name}` }), element("figcaption", {})));
    figure.querySelector("img").src = `/v1/cameras/${encodeURIComponent(camera.name)}.jpg?at=${camera.image_index}`;
    const caption = figure.querySelector("figcaption");
    caption.replaceChildren(camera.name.replace(/^camera_/, "").replaceAll("_", " "), element("span", { class: "quiet" }, age(camera.age_s)));
    known.delete(camera.name);
  }
  for (const figure of known.values()) figure.remove();
}
