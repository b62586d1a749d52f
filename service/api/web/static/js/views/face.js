// @ts-check
/** The face of a loop, as on a controller's front: mode, PV, SP, MV, two upright scales. */
import { html } from "../html.js";
import { fixed, pvDecimals, tick, unit } from "../numbers.js";
import { isSilent, rowOf } from "../state.js";
import { ageWords, valuesOf } from "../values.js";
import { modeWord } from "../words.js";
import { Hatch } from "./loops.js";

/** @param {{loop: any}} props */
export function Face({ loop }) {
  const row = rowOf(loop.tag).value;
  const values = valuesOf(row, isSilent.value);
  const { pv, sp, mv, mode, old } = values;
  const decimals = pvDecimals(loop.pv_limits);
  const outside = pv !== null && !old && (pv < loop.pv_limits.low || pv > loop.pv_limits.high);
  return html`<section class=${`card face ${old ? "old" : ""}`} aria-label=${`Present values of ${loop.tag}`}>
    <div key="mode"><span class=${`mode ${mode === "experiment" ? "test" : mode === "automatic" ? "auto" : "boxed"}`}>${modeWord(mode)}</span>
      ${row?.on_trial && !isSilent.value && html` <span class="mode test">gains on trial</span>`}
      ${old && html` <span key="age" class="age">${ageWords(values)}</span>`}</div>
    <div key="pv"><span class="label">PV</span><span class=${`big pvnum ${outside ? "outside" : ""}`}>${fixed(pv, decimals)}</span> <span class="u">${unit(loop.pv_unit)}</span></div>
    <div class="pair" key="pair"><div><span class="label">SP</span><span class="mid">${fixed(sp, decimals)} <span class="u">${unit(loop.pv_unit)}</span></span></div>
      <div><span class="label">MV</span><span class="mid">${fixed(mv, 1)} <span class="u">%</span></span></div></div>
    ${old ? Scales(loop, null, null, null) : Scales(loop, pv, sp, mv)}
  </section>`;
}

/** @param {any} loop @param {number | null} pv @param {number | null} sp @param {number | null} mv */
function Scales(loop, pv, sp, mv) {
  const { low, high } = loop.pv_limits;
  const y = (/** @type {number} */ value) => 190 - 180 * Math.min(1.02, Math.max(-0.02, (value - low) / (high - low)));
  const m = (/** @type {number} */ value) => 190 - 1.8 * Math.min(100, Math.max(0, value));
  const names = [high, (low + high) / 2, low];
  const distance = (high - low) / 2;
  return html`<svg class="scales" key="scales" viewBox="0 0 250 200" aria-hidden="true">
    ${names.map((value) => html`<g key=${value}><text x="56" y=${y(value) + 4} text-anchor="end">${tick(value, distance / 10)}</text><path d=${`M60 ${y(value)}h6`} class="s-line" /></g>`)}
    <rect x="72" y="10" width="20" height="180" class="f-well s-line" />
    ${pv === null ? Hatch(72, 10, 20, 180) : null}
    ${sp !== null && html`<g key="sp"><rect x="72.5" y=${y(sp + loop.sp_deviation)} width="19" height=${Math.max(0, y(sp - loop.sp_deviation) - y(sp + loop.sp_deviation))} class="f-good" /><path d=${`M94 ${y(sp)}l10 -5v10z`} class="s-ink" /></g>`}
    ${pv !== null && html`<g key="pv"><path d=${`M72 ${y(pv)}h20`} class="s-live" stroke-width="2" /><path d=${`M71 ${y(pv)}l-11 -6v12z`} class="f-live" /></g>`}
    <rect x="160" y="10" width="20" height="180" class="f-well s-line" />
    ${mv === null ? Hatch(160, 10, 20, 180) : html`<rect x="160.5" y=${m(mv)} width="19" height=${190 - m(mv)} class="f-mv" />`}
    <path d=${`M156 ${m(loop.mv_limits.high)}h28M156 ${m(loop.mv_limits.low)}h28`} class="s-ink" />
    ${[100, 50, 0].map((value) => html`<g key=${value}><path d=${`M184 ${m(value)}h6`} class="s-line" /><text x="194" y=${m(value) + 4}>${value}</text></g>`)}
  </svg>`;
}
