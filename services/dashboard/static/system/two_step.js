// A button that acts on its second click within five seconds.

import { element, setText } from "../dom.js";

const CONFIRM_MS = 5000;

export function twoStep(text, act) {
  const button = element("button", { type: "button", class: "danger" }, text);
  let timer = null;
  const end = () => {
    clearTimeout(timer);
    timer = null;
    setText(button, text);
    button.classList.remove("asked");
  };
  button.addEventListener("click", async () => {
    if (timer === null) {
      setText(button, `${text} now`);
      button.classList.add("asked");
      timer = setTimeout(end, CONFIRM_MS);
      return;
    }
    end();
    button.disabled = true;
    try {
      await act();
    } finally {
      button.disabled = false;
    }
  });
  return button;
}
