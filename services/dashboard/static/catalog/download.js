// Downloads MCAP files of items through the dashboard, with progress and a way to cancel.

import { element, say } from "../dom.js";
import { bytes } from "../format.js";
import { ask, checked } from "../session.js";

const BROKE_OFF = "The download broke off; the log of the store says why. Nothing was saved.";

function save(parts, name) {
  const url = URL.createObjectURL(new Blob(parts));
  element("a", { href: url, download: name }).click();
  // The browser reads it after the click.
  setTimeout(() => URL.revokeObjectURL(url), 60_000);
}

async function fetchAll(body, signal, onProgress) {
  const headers = { "content-type": "application/json" };
  const answer = await checked(await ask("/v1/episode_store/downloads", { method: "POST", headers, body: JSON.stringify(body), signal }));
  const expected = Number(answer.headers.get("x-dextouch-estimated-bytes")) || 1;
  const [, name] = /filename="([^"]+)"/.exec(answer.headers.get("content-disposition") ?? "") ?? [null, "dextouch.mcap"];
  const parts = [];
  let received = 0;
  for (const reader = answer.body.getReader(); ;) {
    const { done, value } = await reader.read().catch((error) => {
      throw signal.aborted ? error : new Error(BROKE_OFF);
    });
    if (done) break;
    parts.push(value);
    received += value.length;
    onProgress(received, expected);
  }
  return { parts, name, received };
}

// A button, and what shows how far it is. `listed` gives the body of the request, when it is pressed.
export function downloadControl(listed) {
  const button = element("button", { type: "button", class: "primary" }, "Download MCAP");
  const cancel = element("button", { type: "button", hidden: "" }, "Cancel download");
  const bar = element("progress", { max: "1", hidden: "", "aria-label": "download" });
  const note = element("span", { class: "note", role: "status" });
  let aborting = null;

  const showBusy = (busy) => {
    button.disabled = busy;
    cancel.hidden = bar.hidden = !busy;
    bar.removeAttribute("value");
  };
  cancel.addEventListener("click", () => aborting?.abort());
  button.addEventListener("click", async () => {
    aborting = new AbortController();
    showBusy(true);
    say(note, "The store makes the files.");
    try {
      const { parts, name, received } = await fetchAll(await listed(), aborting.signal, (some, expected) => {
        // The estimate is of the stored bytes; the end is known only when it is there.
        bar.value = Math.min(some / expected, 0.99);
        say(note, `${bytes(some)} of about ${bytes(expected)}`);
      });
      save(parts, name);
      say(note, `${name}, ${bytes(received)}`);
    } catch (error) {
      if (aborting.signal.aborted) say(note, "Cancelled; nothing was saved.", "WARN");
      else say(note, error.message, "ERROR");
    }
    showBusy(false);
  });
  return element("div", { class: "download" }, button, bar, cancel, note);
}
