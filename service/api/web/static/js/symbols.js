// @ts-check
/** Alarms by shape, number and colour; signs of a test and of a decision that is awaited. */
import { html } from "./html.js";

/** @param {1|2|3} priority */
export function AlarmSymbol(priority) {
  const shape = priority === 1 ? html`<rect x="2" y="2" width="16" height="16" rx="1.5" class="a1" />`
    : priority === 2 ? html`<path d="M10 1.5 19 18H1Z" class="a2" />` : html`<path d="M10 1 19 10 10 19 1 10Z" class="a3" />`;
  return html`<svg class="symbol alarm" viewBox="0 0 20 20" role="img" aria-label=${`Alarm of priority ${priority}`}>
    ${shape}<text x="10" y=${priority === 2 ? 16 : 14} text-anchor="middle">${priority}</text></svg>`;
}

export function TestSign() {
  return html`<svg class="symbol" viewBox="0 0 20 20" role="img" aria-label="Under test"><circle cx="10" cy="10" r="7" class="s-sign" /><path d="M10 3a7 7 0 0 0 0 14z" class="sign-fill" /></svg>`;
}

export function DecisionSign() {
  return html`<svg class="symbol" viewBox="0 0 20 20" role="img" aria-label="Awaiting decision"><path d="M10 2 18 10 10 18 2 10Z" class="s-sign" /><path d="M10 7 13 10 10 13 7 10Z" class="sign-fill" /></svg>`;
}
