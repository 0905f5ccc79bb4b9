// The list of studies, with the progress of those that run.

import { cell, element, find, setText, showRows, why } from "./dom.js";
import { date } from "./format.js";
import { LiveLink } from "./live.js";
import { pagePath } from "./requests.js";
import { stateBadge, studyProgress } from "./study_tables.js";

function row(study) {
  const { problem, name } = study;
  const title = problem ? element("strong", {}, name) : element("a", { href: pagePath(`/studies/${encodeURIComponent(name)}`) }, study.title || name);
  return element("tr", { "data-level": problem ? "ERROR" : null }, cell(stateBadge(study)),
    cell([title, why(study.title && study.title !== name ? name : ""), why(problem)], "name"),
    cell(problem ? "–" : studyProgress(study)), cell(problem ? "–" : String(study.num_failed), "number"),
    ...[study.tasks, study.worlds, study.policies].map((names) => cell(names.join(", "), "free")), cell(date(study.changed_at)));
}

function show({ studies, note }) {
  setText(find("summary"), `${studies.length === 1 ? "1 study" : `${studies.length} studies`}, ${studies.filter((one) => one.is_running).length} running`);
  const empty = note ? [note] : ["No studies yet. Run one with ", element("code", {}, "dextouch study run study.toml --folder data/studies/NAME --store data/store"),
    "; ", element("code", {}, "dextouch study run --help"), " has an example of study.toml."];
  showRows(find("study_rows"), studies.map(row), 8, ...empty);
}

new LiveLink({ topics: { studies: show } });
