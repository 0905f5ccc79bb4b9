// Logic of the recorder without DOM: keys, the next sensible step, counts and words.

// Of the Latin letter at this place where another alphabet is typed.
export function keyOf(event) {
  if (event.key.length === 1 && event.key > "\u007f" && event.code.startsWith("Key")) return event.code.slice(3).toLowerCase();
  return event.key.toLowerCase();
}

const NEXT = { idle: "arm", armed: "record", recording: "stop", saved: "arm", discarded: "arm" };

// What one press of a pedal does; null where nothing can be done, "judge" where the outcome is missing.
export function nextStep({ state, judged, changed }) {
  if (state === "checking") return judged ? "save" : "judge";
  if (state === "armed" && changed) return "arm";
  return NEXT[state] ?? null;
}

export function numSaved(session, task, operator) {
  const found = (session?.saved ?? []).find((item) => item.task === task && (item.operator ?? null) === operator);
  return found?.num_saved ?? 0;
}

export function verdict(recorder) {
  const counted = recorder.num_findings ?? 0;
  const word = !recorder.complete ? "Incomplete" : counted ? "Complete, with warnings" : "Complete";
  const note = [recorder.recording_id, counted === 1 ? "1 finding" : `${counted || "no"} findings`].filter(Boolean).join(" · ");
  return { word, note, cause: recorder.cause ?? "", advice: recorder.advice ?? "" };
}

const STAGES = {
  saved: "saved at the station, not uploaded", uploading: "uploading", refused: "refused by the store", stored: "stored",
  aligning: "aligning", aligned: "aligned", failed: "not aligned",
};

export function lastTakeWords(take) {
  return take ? [STAGES[take.stage] ?? take.stage, take.reason].filter(Boolean).join(" · ") : "";
}
