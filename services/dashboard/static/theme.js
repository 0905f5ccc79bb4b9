// The theme of every page, kept in this browser: auto (as the system says), light or dark.

import { keep, kept } from "./dom.js";

const ORDER = ["auto", "light", "dark"];
const { dataset } = document.documentElement;
const button = document.getElementById("theme");
const redraws = [];
let theme = kept("theme");

function apply(name) {
  theme = ORDER.includes(name) ? name : "auto";
  if (theme === "auto") delete dataset.theme;
  else dataset.theme = theme;
  button.querySelector("#theme_name").textContent = theme;
  for (const redraw of redraws) redraw();
}

// Has pictures drawn anew when the colours change.
export function onTheme(redraw) {
  redraws.push(redraw);
}

button.addEventListener("click", () => {
  apply(ORDER[(ORDER.indexOf(theme) + 1) % ORDER.length]);
  keep("theme", theme);
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => apply(theme));
apply(theme);
