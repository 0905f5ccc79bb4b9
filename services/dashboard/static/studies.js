// The list of studies, with the progress of those that run.

import { date } from "./dates.js";
import { element, find, setText, showChildren } from "./dom.js";
import { LiveLink } from "./live.js";
import { pagePath } from "./session.js";
import { progress, stateBadge, why } from "./study_parts.js";

function row(study) {
  const title = study.problem ? element("strong", {}, study.name)
    : element("a", { href: pagePath(`/studies/${encodeURIComponent(study.name)}`) }, study.title || study.name);
  return element("tr", { "data-level": study.problem ? "ERROR" : null },
    element("td", {}, stateBadge(study)),
    element("td", { class: "name" }, title, study.title && study.title !== study.name ? why(study.name) : null, why(study.problem)),
    element("td", {}, study.problem ? "–" : progress(study)),
    element("td", { class: "number" }, study.problem ? "–" : String(study.num_failed)),
    element("td", { class: "free" }, study.tasks.join(", ")),
    element("td", { class: "free" }, study.worlds.join(", ")),
    element("td", { class: "free" }, study.policies.join(", ")),
    element("td", {}, date(study.changed_at)));
}

function show({ studies, note }) {
  setText(find("summary"), `${studies.length === 1 ? "1 study" : `${studies.length} studies`}, ${studies.filter((one) => one.is_running).length} running`);
  const empty = note ? [note] : ["No studies yet. Run one with ", element("code", {}, "dextouch study run study.toml --folder data/studies/NAME --store data/store"),
    "; ", element("code", {}, "dextouch study run --help"), " has an example of study.toml."];
  showChildren(find("study_rows"), (studies.length ? studies.map(row)
    : [element("tr", {}, element("td", { colspan: 8, class: "free" }, ...empty))]));
}

const link = new LiveLink({
  onTopic: (topic, data) => { if (topic === "studies") show(data); },
});
link.show("studies", true);
