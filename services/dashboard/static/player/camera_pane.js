// A camera's picture: the image that is valid at the playhead, with the image's own time below it.

import { element, setText } from "../dom.js";
import { secondsText, stampOf } from "./times.js";

export class CameraPane {
  constructor(track, onToggle) {
    this.track = track;
    this.canvas = element("canvas", { role: "img", "aria-label": `image of ${track.stream.name}`, title: "Double-click to enlarge" });
    const [height, width] = track.stream.shape;
    Object.assign(this.canvas, { width, height });
    this.message = element("p", { class: "pane_message" });
    this.time = element("time", { class: "own_time" });
    this.root = element("figure", { class: "camera", "data-camera": track.stream.name, "data-state": "loading" },
      element("div", { class: "picture" }, this.canvas, this.message),
      element("figcaption", {}, element("span", { class: "name" }, track.stream.name), this.time));
    this.canvas.addEventListener("dblclick", onToggle);
    this.asked = 0;
    this.drawn = 0;
    this.drawn_key = "";
    this.decoding_key = "";
  }

  // Half size is enough where the picture is shown small, or changes fast.
  chooseSize(speed) {
    const width_px = this.canvas.clientWidth * (window.devicePixelRatio || 1);
    this.track.half_size = speed >= 2 || (width_px > 0 && 2 * width_px <= this.track.stream.shape[1]);
  }

  show(t_ns) {
    const found = this.track.sampleAt(t_ns);
    this.wanted_key = found.state === "sample" ? `${found.t_ns} ${this.track.half_size}` : "";
    if (found.state === "none") {
      this.drawn = this.asked;
      this.drawn_key = this.decoding_key = "";
      this.state("none", "no sample");
      setText(this.time, "");
      delete this.root.dataset.stamp;
    } else if (found.state === "loading") {
      this.state(found.error ? "failed" : "loading", found.error?.message ?? "");
    } else {
      const image = found.data.images[found.index];
      const key = this.wanted_key;
      if (key === this.drawn_key) {
        // An image that is still being decoded is not wanted any more.
        this.drawn = this.asked;
        this.decoding_key = "";
        this.state("shown", "");
      } else if (key !== this.decoding_key) this.draw(image, found.t_ns, key);
    }
  }

  state(name, message) {
    this.root.dataset.state = name;
    setText(this.message, message);
  }

  async draw(bytes, t_ns, key) {
    const number = (this.asked += 1);
    this.decoding_key = key;
    this.state("loading", "");
    let bitmap;
    try {
      // As the sensor delivered it: EXIF orientation is ignored everywhere.
      bitmap = await createImageBitmap(new Blob([bytes], { type: "image/jpeg" }), { imageOrientation: "none" });
    } catch {
      if (key === this.wanted_key) this.state("failed", "this image cannot be decoded");
      return;
    } finally {
      if (this.decoding_key === key) this.decoding_key = "";
    }
    // Images may be decoded out of order; one that is older than the picture is not shown any more.
    if (number > this.drawn) {
      this.drawn = number;
      this.drawn_key = key;
      if (this.canvas.width !== bitmap.width) Object.assign(this.canvas, { width: bitmap.width, height: bitmap.height });
      this.canvas.getContext("2d").drawImage(bitmap, 0, 0);
      setText(this.time, `${secondsText(Math.round(t_ns / 1e5) * 1e5)} s`);
      this.root.dataset.stamp = stampOf(t_ns, this.track.item.zero);
      if (key === this.wanted_key) this.state("shown", "");
    }
    bitmap.close();
  }
}
