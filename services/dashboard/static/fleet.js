// Wall of stations: a tile each, trouble first; a tile opens its station's page.

import { showImage } from "./cameras.js";
import { element, find, levelBadge, placeChildren, setText } from "./dom.js";
import { age, number, plural, stopwatch } from "./format.js";
import { HandCanvas } from "./hands.js";
import { Freshness, LiveLink } from "./live.js";
import { ask, stationPath } from "./requests.js";
import { onTheme } from "./theme.js";

const STALE_MS = 800;
const IMAGE_PERIOD_MS = 1000;
const SIDES = ["left", "right"];
const NOTHING = new Float32Array(0);
const heatmap = await (await ask("/v1/heatmap")).json();

function diskText({ disk_left_s, disk_free_bytes }) {
  const free = disk_free_bytes === null ? "–" : `${number(disk_free_bytes / 1e9, 0)} GB`;
  return disk_left_s === null ? free : `${free}, ${age(disk_left_s)} of recording`;
}

class StationTile {
  constructor(name) {
    const canvases = SIDES.map((side) => element("canvas", { class: "hand", role: "img", "aria-label": `taxels of the ${side} hand` }));
    this.badge = element("span", {});
    this.timer = element("span", { class: "timer" });
    this.task = element("span", { class: "task" });
    this.cause = element("p", { class: "cause" });
    this.advice = element("p", { class: "to_do" });
    this.facts = { today: element("dd", {}), disk: element("dd", {}) };
    this.camera = element("div", { class: "picture" });
    this.image_ms = 0;
    this.node = element("li", { class: "tile", "data-station": name }, element("a", { href: `/?station=${encodeURIComponent(name)}` },
      element("div", { class: "tile_head" }, this.badge, element("strong", {}, name), this.timer),
      element("p", { class: "doing" }, this.task),
      this.cause, this.advice,
      element("div", { class: "pictures" }, ...canvases, this.camera),
      element("dl", {}, element("div", {}, element("dt", {}, "today"), this.facts.today), element("div", {}, element("dt", {}, "disk"), this.facts.disk))));
    this.hands = Object.fromEntries(SIDES.map((side, index) => [side, new HandCanvas(canvases[index], {}, side, heatmap)]));
  }

  show(tile) {
    this.tile = tile;
    this.node.dataset.level = tile.level;
    if (this.badge.firstChild?.textContent !== tile.level) this.badge.replaceChildren(levelBadge(tile.level));
    this.node.dataset.recorder = tile.recorder;
    const recording = tile.recorder === "recording";
    setText(this.timer, recording ? `● ${stopwatch(tile.duration_s)}` : tile.recorder === "unknown" ? "" : tile.recorder);
    setText(this.task, tile.task ?? (tile.recorder === "unknown" ? "" : "no task"));
    setText(this.cause, tile.cause);
    setText(this.advice, tile.advice);
    this.node.title = tile.cause;
    setText(this.facts.today, number(tile.hours_today, 2, "h"));
    setText(this.facts.disk, diskText(tile));
    this.showCamera(tile.camera);
    for (const side of SIDES) {
      this.hands[side].use(tile.layouts?.[side] ?? null);
      if (!tile.gloves.includes(side)) this.hands[side].update(NOTHING);
    }
  }

  showCamera(camera) {
    const now_ms = performance.now();
    if (camera === null) this.camera.replaceChildren();
    else if (now_ms - this.image_ms > IMAGE_PERIOD_MS || !this.camera.firstChild) {
      this.image_ms = now_ms;
      showImage(this.camera, camera, ({ name, image_index }) => stationPath(`/v1/cameras/${encodeURIComponent(name)}.jpg?at=${image_index}`, this.tile.name));
    }
  }

  // `count` is the number of taxels of the left hand, which come first.
  showTaxels(pressures_kpa, count) {
    const hands = { left: pressures_kpa.subarray(0, count), right: pressures_kpa.subarray(count) };
    for (const side of SIDES) if (this.tile.gloves.includes(side)) this.hands[side].update(hands[side]);
  }

  clear(cause) {
    this.show({ name: this.tile.name, level: "STALE", cause, advice: "", recorder: "unknown", task: null, duration_s: null, hours_today: null,
      disk_left_s: null, disk_free_bytes: null, camera: null, gloves: [] });
  }
}

const tiles = new Map();
let order = [];

function show(shown) {
  for (const tile of shown) {
    if (!tiles.has(tile.name)) tiles.set(tile.name, new StationTile(tile.name));
    tiles.get(tile.name).show(tile);
  }
  order = shown.map(({ name }) => name);
  placeChildren(find("tiles"), order.map((name) => tiles.get(name).node));
  const counts = ["ERROR", "STALE", "WARN", "OK"].map((level) => [shown.filter((tile) => tile.level === level).length, level]);
  setText(find("counts"), `${plural(shown.length, "station")}: ${counts.filter(([count]) => count > 0).map(([count, level]) => `${count} ${level}`).join(" · ")}`);
}

const clearAll = (cause) => tiles.forEach((tile) => tile.clear(cause));
const fresh = new Freshness(STALE_MS, () => clearAll("The dashboard sends no updates."));

new LiveLink({
  topics: { fleet: (shown) => {
    fresh.note();
    show(shown);
  } },
  onBinary: (buffer) => {
    // uint8 kind (3), uint8 place in the list, uint16 number of taxels of the left hand, float32 kPa of the left, then of the right hand.
    const view = new DataView(buffer);
    if (view.getUint8(0) === 3) tiles.get(order[view.getUint8(1)])?.showTaxels(new Float32Array(buffer, 4), view.getUint16(2, true));
  },
  onLost: () => {
    fresh.stop();
    clearAll("No link to the dashboard.");
  },
});
onTheme(() => tiles.forEach((tile) => Object.values(tile.hands).forEach((hand) => hand.request())));
