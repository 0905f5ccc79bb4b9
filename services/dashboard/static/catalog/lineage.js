// Dialog with what an item was made from, what was made from it, and its alignment jobs.

import { element } from "../dom.js";
import { pagePath } from "../session.js";
import { get, getIfServed } from "./api.js";
import { under } from "./cells.js";

const RELATIONS = [["source", "Made from"], ["self", "This item"], ["product", "Made from this item"]];
const PLAYED = ["recording", "episode"];

// A line of an item's lineage.
export function nodeItem(node, relation = "") {
  const name = node.is_stored && PLAYED.includes(node.kind)
    ? element("a", { href: pagePath(`/episodes/${node.kind}/${encodeURIComponent(node.id)}`) }, node.id)
    : element("strong", {}, node.id);
  const known = node.is_stored || !PLAYED.includes(node.kind) ? node.summary : "not in this store: deleted, or elsewhere";
  return element("li", {}, element("span", { class: "quiet" }, `${relation} ${node.kind} `.trimStart()), name, under(known));
}

function jobItem(job) {
  const share = job.state === "running" ? `, ${Math.round(100 * job.progress)} %` : "";
  return element("li", {}, element("span", { class: "quiet" }, `${job.state}${share}`), element("strong", {}, job.alignment_id),
    under(job.problem?.detail ?? (job.attempts > 1 ? `${job.attempts} attempts` : "")));
}

function part(title, items) {
  return items.length ? [element("h3", {}, title), element("ul", { class: "lineage" }, ...items)] : [];
}

export async function showLineage(dialog, { kind, id }) {
  const body = dialog.querySelector("[data-body]");
  dialog.querySelector("[data-title]").textContent = id;
  body.replaceChildren(element("p", { class: "note" }, "loading"));
  if (!dialog.open) dialog.showModal();
  try {
    const { nodes } = await get(`/v1/episode_store/catalog/lineage/${kind}/${encodeURIComponent(id)}`);
    const recordings = nodes.filter((node) => node.kind === "recording").map((node) => ["recording_id", node.id]);
    const query = new URLSearchParams(recordings);
    const { alignments } = recordings.length
      ? await getIfServed(`/v1/alignment/alignments?${query}`, { alignments: [] }) : { alignments: [] };
    body.replaceChildren(
      ...RELATIONS.flatMap(([relation, title]) => part(title, nodes.filter((node) => node.relation === relation).map(nodeItem))),
      ...part("Alignments", alignments.map(jobItem)));
  } catch (error) {
    body.replaceChildren(element("p", { class: "note", "data-level": "ERROR", role: "alert" }, error.message));
  }
}
