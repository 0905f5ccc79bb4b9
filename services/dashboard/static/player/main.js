// The player of a recording or an episode: all panes show the moment at one playhead.

import { element, find, setText } from "../dom.js";
import { drawScale } from "../hands.js";
import { ask } from "../session.js";
import { onTheme } from "../theme.js";
import { Editing } from "./editing.js";
import { outcomeBadge, showFacts } from "./facts.js";
import { Item } from "./item.js";
import { Player } from "./player.js";
import { parseState } from "./url_state.js";


function showTitle({ about }) {
  document.title = `${about.id} · ${document.title}`;
  setText(find("item_id"), about.id);
  setText(find("item_kind"), about.kind);
  find("outcome").replaceChildren(outcomeBadge(about.success));
  setText(find("instruction"), [about.task, about.instruction].filter((text) => text).join(" · "));
}

async function open() {
  const [, , kind, id] = location.pathname.split("/").map(decodeURIComponent);
  const [item, heatmap] = await Promise.all([Item.open(kind, id), ask("/v1/heatmap").then((answer) => answer.json())]);
  showTitle(item);
  drawScale(find("scale"), heatmap);
  const isRaw = item.ofKind("tactile").some((stream) => stream.unit !== "kPa");
  setText(find("scale_end"), isRaw ? "largest count" : `${heatmap.full_scale_kpa} kPa`);
  const player = new Player(item, heatmap, parseState(location.search));
  const editing = new Editing(player);
  showFacts(find("facts"), item, (span) => {
    editing.select(span);
    player.seek(span[0]);
  });
  return player;
}

let player = null;
onTheme(() => player?.recolour());
try {
  player = await open();
  find("player").hidden = find("deck").hidden = false;
  player.start();
} catch (error) {
  find("failure").replaceChildren(element("p", { class: "note", "data-level": "ERROR", role: "alert" }, `This item cannot be played: ${error.message}`));
}
