// Live hands and poses of a station in space, and the state of each tracker.

import { css } from "./canvas.js";
import { element, levelBadge, showChildren } from "./dom.js";
import { age } from "./format.js";
import { OrbitCanvas } from "./orbit_canvas.js";
import { scene } from "./poses.js";

const LIST_PERIOD_MS = 250;

export class PoseView {
  constructor(canvas, list, bones) {
    this.view = new OrbitCanvas(canvas, { paint: () => this.paint() });
    this.request = this.view.request;
    this.list = list;
    this.bones = bones;
    this.streams = [];
    this.note = "waiting for poses";
    this.listed = { text: "", at_ms: 0 };
  }

  update(streams) {
    this.streams = streams;
    this.note = streams.length === 0 ? "This station has no trackers." : "";
    this.showList();
    this.request();
  }

  clear(reason) {
    this.update(this.streams.map((stream) => ({ ...stream, age_s: null, values: new Float32Array(0) })));
    this.note = reason;
  }

  // Age and state of each stream: four times a second, and at once when a state changes.
  showList() {
    const text = this.streams.map(({ name, values }) => `${name} ${values.length > 0}`).join();
    const now_ms = performance.now();
    if (text === this.listed.text && now_ms - this.listed.at_ms < LIST_PERIOD_MS) return;
    this.listed = { text, at_ms: now_ms };
    showChildren(this.list, this.streams.map(({ name, age_s, values }) => element("li", { "data-stream": name },
      levelBadge(values.length > 0 ? "OK" : "STALE"),
      element("span", {}, name.replaceAll("_", " ")),
      element("span", { class: "quiet" }, age_s === null ? "no data" : age(age_s)))));
  }

  paint() {
    const pen = this.view;
    const { bodies, hands } = scene(this.streams);
    pen.begin([...bodies.map(({ T_world_body: T }) => [T[3], T[7], T[11]]), ...hands.flatMap((hand) => hand.points_world)]);
    for (const { name, T_world_body } of bodies) pen.body(name, T_world_body);
    for (const { side, placed, points_world } of hands) {
      const colour = css(`--hand_${side}`);
      pen.style(colour, 3, placed ? [] : [5, 5]);
      for (const [parent, node] of this.bones) pen.line(points_world[parent], points_world[node]);
      points_world.forEach((point) => pen.dot(point, colour, 2.6));
      if (!placed) pen.label(`${side} hand, wrist not tracked`, points_world[0], colour);
    }
    if (this.note) pen.note(this.note);
  }
}
