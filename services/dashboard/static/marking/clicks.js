// What clicks on the objects of an episode mean: which object the next one is for, and what is left to click.

// What is said of an object: "open", "heading" (the first click is there, the second not), or "done".
export function stateOf(object, click) {
  if (!click) return "open";
  const needs = click.state === "seen" && !object.click?.symmetric && !click.heading_px;
  return needs ? "heading" : "done";
}

export function isDone(objects, clicks) {
  return objects.every((object) => stateOf(object, clicks[object.name]) === "done");
}

// The object after this one that has something left to click; the same if none has.
export function nextOpen(objects, clicks, active) {
  const order = [...objects.keys()].map((step) => (active + step) % objects.length);
  return order.find((index) => stateOf(objects[index], clicks[objects[index].name]) !== "done") ?? active;
}

// Clicks with one more on an object: its point, its heading, or a new point in place of both.
export function withClick(object, clicks, pixel) {
  const old = clicks[object.name];
  const click = stateOf(object, old) === "heading" ? { ...old, heading_px: pixel } : { state: "seen", point_px: pixel };
  return { ...clicks, [object.name]: click };
}

export function withState(object, clicks, state) {
  return { ...clicks, [object.name]: { state } };
}

// The next episode that is not done, after the current one and around; the one after it if all are.
export function nextEpisode(objects, episodes, current) {
  const order = episodes.map((_, step) => (current + 1 + step) % episodes.length);
  const open = (index) => !isDone(objects, episodes[index].clicks?.objects ?? {});
  return order.find((index) => index !== current && open(index)) ?? order[0] ?? 0;
}

export function counts(objects, episodes) {
  return { done: episodes.filter((one) => one.clicks && isDone(objects, one.clicks.objects)).length, all: episodes.length };
}
