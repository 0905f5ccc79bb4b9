// The page: one live link feeds the panels; a panel that is out of sight is not sent.

import { DevicesPanel } from "./devices.js";
import { setText } from "./dom.js";
import { drawScale, HandCanvas, readTaxels } from "./hands.js";
import { showCameras, showRefused, showServices, showTakes } from "./lists.js";
import { LiveLink } from "./live.js";
import { RecorderPanel } from "./recorder.js";
import { ask } from "./session.js";
import { startTheme } from "./theme.js";

const find = (id) => document.getElementById(id);
const heatmap = await (await ask("/v1/heatmap")).json();
const hands = {
  left: new HandCanvas(find("hand_left"), find("hand_left_text"), "left", heatmap),
  right: new HandCanvas(find("hand_right"), find("hand_right_text"), "right", heatmap),
};
const recorder = new RecorderPanel(find("recorder"));
const devices = new DevicesPanel(find("devices"));
drawScale(find("scale"), heatmap);
setText(find("scale_end"), `${heatmap.full_scale_kpa} kPa`);

function showStation(station) {
  const overall = find("overall");
  overall.dataset.level = station.level;
  setText(overall, station.level);
  setText(find("summary"), station.summary);
  devices.show(station);
  recorder.show(station.recorder, station.level);
}

const topics = {
  station: showStation,
  trends: (trends) => devices.showTrends(trends),
  services: (services) => showServices(find("service_list"), services),
  takes: (takes) => {
    showTakes(find("take_rows"), takes);
    showRefused(find("refused_list"), takes.refused);
  },
  last_take: (take) => recorder.showLast(take),
  cameras: (cameras) => showCameras(find("cameras"), find("camera_row"), cameras),
  taxels_lost: (reason) => Object.values(hands).forEach((hand) => hand.clear(reason)),
};

const link = new LiveLink({
  onTopic: (topic, data) => topics[topic]?.(data),
  onBinary: (buffer) => {
    const taxels = readTaxels(buffer);
    if (taxels) hands[taxels.side].update(taxels.pressures_kpa);
  },
  onState: (connected) => {
    setText(find("link"), connected ? "live" : "dashboard not reachable, trying again");
    if (!connected) {
      showStation({ level: "STALE", summary: "", note: "No link to the dashboard: what you see is old.", note_level: "ERROR", reachable: false,
        host: null, causes: [], streams: [], recorder: { state: "unknown", actions: [], elapsed_s: null, problems: [], level: "STALE" } });
      Object.values(hands).forEach((hand) => hand.clear("no link"));
    }
  },
});

// State of station and last take is wanted wherever the page is scrolled; the camera panel is hidden until one exists.
link.show("station", true);
link.show("trends", true);
link.show("cameras", true);
link.show("last_take", true);
const observer = new IntersectionObserver((entries) => {
  for (const entry of entries) link.show(entry.target.dataset.view, entry.isIntersecting);
});
for (const section of document.querySelectorAll("[data-view]")) {
  if (!["station", "cameras"].includes(section.dataset.view)) observer.observe(section);
}
document.addEventListener("visibilitychange", () => link.sendView());
startTheme(find("theme"), () => Object.values(hands).forEach((hand) => hand.request()));
