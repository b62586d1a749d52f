// @ts-check
/** Light and dark: follows the system until one is chosen. */
import { effect, signal } from "../vendor/signals-core.js";
import { read, write } from "./state.js";

const CHOICES = ["auto", "light", "dark"];
const system = matchMedia("(prefers-color-scheme: dark)");
export const palette = signal(CHOICES.includes(read("loopwright.palette")) ? read("loopwright.palette") : "auto");
/** Which palette is shown; plots are drawn anew when it changes. */
export const shown = signal("light");

export function beginPalette() {
  const choose = () => (palette.value === "auto" ? (system.matches ? "dark" : "light") : palette.value);
  effect(() => {
    shown.value = choose();
    document.documentElement.dataset.palette = shown.value;
    colours.clear();
  });
  system.addEventListener("change", () => {
    palette.value = palette.peek();
    shown.value = choose();
    document.documentElement.dataset.palette = shown.value;
    colours.clear();
  });
}

export function cyclePalette() {
  palette.value = CHOICES[(CHOICES.indexOf(palette.value) + 1) % CHOICES.length];
  write("loopwright.palette", palette.value);
}

/** @type {Map<string, string>} */
const colours = new Map();
/** The colour of a token, for canvases. @param {string} token */
export function colour(token) {
  let found = colours.get(token);
  if (!found) colours.set(token, (found = getComputedStyle(document.documentElement).getPropertyValue(`--${token}`).trim()));
  return found;
}
