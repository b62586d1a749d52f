// @ts-check
/** The list of keys. */
import { signal } from "../../vendor/signals-core.js";
import { html } from "../html.js";

export const keysShown = signal(false);

const KEYS = [
  ["Ctrl+.", "aborts the test in the dock"],
  ["/", "find, in Loops"],
  ["j k Enter", "next row, previous row, open"],
  ["g l, g j, g a", "Loops, Jobs, Alarms"],
  ["1 … 4, t", "windows of the trend, the test"],
  ["arrows, Home, End", "the slider, from one design to the next"],
  ["Esc", "closes a form or a question; the slider goes back"],
  ["?", "this list"],
];

export function KeysView() {
  if (!keysShown.value) return null;
  return html`<section class="keys" role="dialog" aria-label="Keys"><h2>Keys</h2>
    <dl class="pairs">${KEYS.map(([key, does]) => html`<dt key=${key}><kbd>${key}</kbd></dt><dd>${does}</dd>`)}</dl>
    <p class="foot"><button onClick=${() => (keysShown.value = false)}>Close</button></p></section>`;
}
