// Light or dark, and the colours that plots have then.

import { $, schedule, setText } from "./dom.js";

/** Colours of the plots, by what they show; page.css has them. */
export let colour = {};
const COLOURS = [
  "stance", "contact", "truth", "command", "reading", "predicted", "ratio", "carries",
  "threshold", "grid", "dim", "bad", "withheld", "accent", "card",
];

function readColours() {
  const style = getComputedStyle(document.documentElement);
  colour = Object.fromEntries(COLOURS.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}

const dark = matchMedia("(prefers-color-scheme: dark)");
const THEMES = ["auto", "light", "dark"];

export function applyTheme() {
  let wanted = "auto";
  try {
    wanted = localStorage.getItem("theme") || "auto";
  } catch {
    // Storage may be forbidden; then the choice lasts for this visit.
  }
  if (!THEMES.includes(wanted)) wanted = "auto";
  const used = wanted === "auto" ? (dark.matches ? "dark" : "light") : wanted;
  document.documentElement.dataset.theme = used;
  setText($("theme"), `◐ ${wanted}`);
  readColours();
  schedule();
}

/** Take the next of the three, and keep it for the next visit. */
export function nextTheme() {
  const now = $("theme").textContent.replace("◐ ", "");
  try {
    localStorage.setItem("theme", THEMES[(THEMES.indexOf(now) + 1) % THEMES.length]);
  } catch {
    // As in `applyTheme`.
  }
  applyTheme();
}

dark.addEventListener("change", applyTheme);
