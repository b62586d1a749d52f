// @ts-check
/** Small figures as SVG: the curve of Ms, steps, Nyquist. Axes do not change with the slider. */
import { html } from "../html.js";
import { fixed, ms as msText, tick } from "../numbers.js";
import { tickDistance } from "../plot.js";

/** @param {number} width in pixels, so that text keeps its size @param {{ms: number, IAE: number}[]} points @param {number} ms @param {number} tested @param {number | null} msBefore @param {number | null} iaeBefore */
export function Curve(width, points, ms, tested, msBefore, iaeBefore) {
  const low = points[0]?.ms ?? 1.2;
  const high = points[points.length - 1]?.ms ?? 2;
  const range = high > low ? high - low : 1;
  const x = (/** @type {number} */ value) => (high > low ? 8 + ((width - 16) * (value - low)) / range : width / 2);
  const logs = points.map((each) => -Math.log(each.IAE));
  const bottom = Math.min(...logs);
  const top = Math.max(...logs);
  const y = (/** @type {number} */ iae) => 108 - (top > bottom ? (78 * (-Math.log(iae) - bottom)) / (top - bottom) : 40);
  const line = points.map((each, n) => `${n ? "L" : "M"}${x(each.ms).toFixed(1)} ${y(each.IAE).toFixed(1)}`).join("");
  const after = points.findIndex((each) => each.ms >= ms - 1e-9);
  const b = points[Math.max(0, after)];
  const a = points[Math.max(0, after - 1)];
  const part = b && a && b.ms > a.ms ? Math.min(1, Math.max(0, (ms - a.ms) / (b.ms - a.ms))) : 1;
  const iae = a && b ? Math.exp(Math.log(a.IAE) + part * Math.log(b.IAE / a.IAE)) : 1;
  const inside = msBefore !== null && iaeBefore !== null && msBefore >= low && msBefore <= high;
  return html`<svg viewBox=${`0 0 ${width} 130`} role="img" aria-label="Disturbance rejection for each Ms">
    ${points.length > 1 && html`<path key="area" d=${`${line}L${x(high)} 126L${x(low)} 126Z`} class="f-band" /><path key="line" d=${line} class="s-new" />`}
    <path d=${`M${x(tested)} 8V126`} class="s-pale" />
    ${inside && html`<circle key="before" cx=${x(/** @type {number} */ (msBefore))} cy=${y(/** @type {number} */ (iaeBefore))} r="5" class="s-ink" />`}
    ${points.length > 0 && html`<circle key="dot" cx=${x(ms)} cy=${y(iae)} r="6" class="f-new" />`}
    <text x="12" y="14">faster disturbance rejection ↑</text>
    ${msBefore !== null && !inside && html`<text key="off" x=${msBefore > high ? width - 8 : 8} y="124" text-anchor=${msBefore > high ? "end" : "start"}>previous: Ms ${msText(msBefore)} ${msBefore > high ? "→" : "←"}</text>`}
  </svg>`;
}

/** The height of a small figure: that of its neighbours, and not taller than a small screen shows. @param {number} width */
function heightOf(width) {
  return Math.round(Math.min(240, Math.max(150, 0.65 * width)));
}

/**
 * @param {number} W width in pixels @param {import("../designs.js").StepCurve | null} before @param {import("../designs.js").StepCurve} after
 * @param {number} size of the step @param {boolean} ofSetpoint @param {string} label
 */
export function StepPlot(W, before, after, size, ofSetpoint, label) {
  const setpoint = ofSetpoint ? size : 0;
  const [H, L, B] = [heightOf(W), 46, 20];
  let low = Math.min(0, setpoint);
  let high = Math.max(0, setpoint);
  const consider = before ? [before, after] : [after];
  for (const each of consider) for (const value of each.pv) {
    low = Math.min(low, size * value);
    high = Math.max(high, size * value);
  }
  if (setpoint) {
    low = Math.max(low, -Math.abs(setpoint));
    high = Math.min(high, 2.2 * Math.abs(setpoint));
  }
  const pad = (high - low) * 0.06 || 1;
  low -= pad;
  high += pad;
  const end = after.horizon_s;
  const x = (/** @type {number} */ t) => L + ((W - L - 4) * t) / end;
  const y = (/** @type {number} */ v) => 6 + (H - B - 6) * (1 - (Math.min(high, Math.max(low, v)) - low) / (high - low));
  const path = (/** @type {import("../designs.js").StepCurve} */ found) =>
    found.pv.map((value, n) => `${n ? "L" : "M"}${x((n * found.horizon_s) / (found.pv.length - 1)).toFixed(1)} ${y(size * value).toFixed(1)}`).join("");
  const dy = tickDistance(high - low, 4);
  const dx = tickDistance(end, 4);
  const ys = [];
  for (let n = Math.ceil(low / dy); n * dy <= high; n++) ys.push(n * dy);
  const xs = [];
  for (let n = 0; n * dx <= end; n++) xs.push(n * dx);
  return html`<svg viewBox=${`0 0 ${W} ${H}`} role="img" aria-label=${label}>
    ${ys.map((v) => html`<g key=${`y${v}`}><path d=${`M${L} ${y(v)}H${W - 4}`} class="s-grid" /><text x=${L - 4} y=${y(v) + 4} text-anchor="end">${tick(v, dy)}</text></g>`)}
    ${xs.map((t) => html`<g key=${`x${t}`}><path d=${`M${x(t)} 6V${H - B}`} class="s-grid" /><text x=${x(t)} y=${H - 6} text-anchor="middle">${tick(t, dx)}</text></g>`)}
    ${setpoint ? html`<path key="sp" d=${`M${L} ${y(setpoint)}H${W - 4}`} class="s-sp" />` : null}
    ${before && html`<path key="before" d=${path(before)} class="s-old" />`}<path key="after" d=${path(after)} class="s-new" /></svg>`;
}

/** @param {number} width in pixels @param {import("../designs.js").Curves | null} before @param {import("../designs.js").Curves} after @param {number} Ms */
export function NyquistPlot(width, before, after, Ms) {
  const [W, H] = [width, heightOf(width * 1.25)];
  const scale = 0.34 * Math.min(H, W);
  const x = (/** @type {number} */ re) => 0.59 * W + scale * re;
  const y = (/** @type {number} */ im) => 0.365 * H - scale * im;
  const path = (/** @type {import("../designs.js").Curves} */ f) => {
    let d = "";
    let pen = false;
    for (let n = 0; n < f.nyquist_re.length; n++) {
      const [px, py] = [x(f.nyquist_re[n]), y(f.nyquist_im[n])];
      if (px < -60 || px > W + 60 || py < -60 || py > H + 60) {
        pen = false;
        continue;
      }
      d += `${pen ? "L" : "M"}${px.toFixed(1)} ${py.toFixed(1)}`;
      pen = true;
    }
    return d;
  };
  return html`<svg viewBox=${`0 0 ${W} ${H}`} role="img" aria-label=${`Nyquist: the largest sensitivity Ms is ${fixed(Ms, 2)}`}>
    <circle cx=${x(-1)} cy=${y(0)} r=${scale / Ms} class="f-band s-soft" /><circle cx=${x(0)} cy=${y(0)} r=${scale} class="s-pale" />
    <path d=${`M0 ${y(0)}H${W}M${x(0)} 0V${H}`} class="s-grid" />
    ${before && html`<path key="before" d=${path(before)} class="s-old" />`}<path key="after" d=${path(after)} class="s-new" />
    <circle cx=${x(-1)} cy=${y(0)} r="2.5" class="f-ink" /><text x=${x(-1) - 5} y=${y(0) - 5} text-anchor="end">−1</text>
    <text x=${x(-1)} y=${Math.max(11, y(0) - scale / Ms - 5)} text-anchor="middle">1/Ms = ${fixed(1 / Ms, 2)}</text></svg>`;
}
