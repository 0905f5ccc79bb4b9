// A command line that is shown to be copied, and its quoting.

import { element, setText } from "./dom.js";

// As a shell takes it: plain names as they are, anything else in quotes.
export function quote(text) {
  return /^[\w@%+=:,./-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`;
}

// `show` puts another command in its place.
export function commandLine(text = "") {
  const copy = element("button", { type: "button", class: "plain" }, "Copy");
  const code = element("code", {}, text);
  copy.addEventListener("click", async () => {
    try {
      await navigator.clipboard.writeText(code.textContent);
      copy.textContent = "Copied";
    } catch {
      // Pages that are not served from loopback or by HTTPS have no clipboard.
      getSelection().selectAllChildren(code);
      copy.textContent = "Selected";
    }
  });
  const node = element("p", { class: "command" }, code, copy);
  const show = (changed) => {
    setText(code, changed);
    setText(copy, "Copy");
  };
  return { node, show };
}
