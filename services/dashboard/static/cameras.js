// Newest images of the cameras: thumbnails, and one of them larger. An image that is too old is removed, not kept.

import { button, element, setText } from "./dom.js";
import { age } from "./format.js";
import { stationPath } from "./requests.js";

const STALE_S = 0.7;

export class CameraPanel {
  constructor(section, row, dialog) {
    Object.assign(this, { section, row, dialog, larger: "", figures: new Map() });
    this.dialog.addEventListener("close", () => {
      this.larger = "";
      this.dialog.querySelector(".picture").replaceChildren();
    });
    this.dialog.addEventListener("click", () => this.dialog.close());
  }

  show(cameras) {
    // Once there, the panel stays, so that nothing moves when images are late.
    if (cameras.length > 0) this.section.hidden = false;
    const gone = new Set(this.figures.keys());
    for (const camera of cameras) {
      gone.delete(camera.name);
      const figure = this.figures.get(camera.name) ?? this.add(camera.name);
      showImage(figure.querySelector(".picture"), camera);
      setText(figure.querySelector(".age"), age(camera.age_s));
      if (camera.name === this.larger) this.showLarger(camera);
    }
    for (const name of gone) {
      this.figures.get(name).remove();
      this.figures.delete(name);
    }
    if (gone.has(this.larger)) this.dialog.close();
  }

  add(name) {
    const open = button([], () => {
      this.larger = name;
      this.dialog.showModal();
    }, { class: "picture", title: "Larger" });
    const figure = element("figure", { "data-name": name }, open,
      element("figcaption", {}, label(name), " ", element("span", { class: "age quiet" })));
    this.figures.set(name, figure);
    this.row.append(figure);
    return figure;
  }

  showLarger(camera) {
    showImage(this.dialog.querySelector(".picture"), camera);
    setText(this.dialog.querySelector(".age"), `${label(camera.name)} · ${camera.width_px} × ${camera.height_px} · ${age(camera.age_s)}`);
  }
}

function label(name) {
  return name.replace(/^camera_/, "").replaceAll("_", " ");
}

// An image element while the newest image is fresh, words in its place otherwise.
export function showImage(place, camera, url = imageUrl) {
  if (camera.age_s > STALE_S) {
    if (!place.querySelector(".lost")) place.replaceChildren(element("span", { class: "lost quiet" }, "no image"));
    return;
  }
  let image = place.querySelector("img");
  if (!image) place.replaceChildren(image = element("img", { alt: `newest image of ${camera.name}` }));
  const address = url(camera);
  if (image.getAttribute("src") !== address) image.src = address;
}

function imageUrl(camera) {
  return stationPath(`/v1/cameras/${encodeURIComponent(camera.name)}.jpg?at=${camera.image_index}`);
}
