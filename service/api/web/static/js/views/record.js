// @ts-check
/** The record of a job with its model, what the model leaves, and MV, as the service has stored them. */
import { useEffect, useRef, useState } from "../../vendor/hooks.js";
import { ask } from "../api.js";
import { html } from "../html.js";
import { pvDecimals, fixed, unit } from "../numbers.js";
import { colour, shown } from "../palette.js";
import { makePlot, mark, yRange } from "../plot.js";
import { markName } from "../words.js";

/** @param {{loop: any, job: any}} props */
export function Record({ loop, job }) {
  const [record, setRecord] = useState(/** @type {any} */ (null));
  const [words, setWords] = useState("Asking for the record…");
  const [readout, setReadout] = useState("");
  const pv = useRef(/** @type {HTMLElement | null} */ (null));
  const left = useRef(/** @type {HTMLElement | null} */ (null));
  const mv = useRef(/** @type {HTMLElement | null} */ (null));
  useEffect(() => {
    const stop = new AbortController();
    ask(`${job.url}/record?points=1500`, stop.signal).then(
      (found) => setRecord(columns(found)),
      (error) => {
        if (!stop.signal.aborted) setWords(error.message);
      },
    );
    return () => stop.abort();
  }, [job.id]);
  useEffect(() => {
    if (!record || !pv.current || !mv.current) return;
    const key = `record ${job.id}`;
    const all = /** @type {[number, number]} */ ([record.t[0], record.t[record.t.length - 1]]);
    let x = all;
    const decimals = pvDecimals(loop.pv_limits);
    const marks = (/** @type {any} */ u, /** @type {any} */ ctx, /** @type {boolean} */ named) => {
      let last = -Infinity;
      let row = 0;
      for (const [n, each] of record.marks.entries()) {
        const at = u.valToPos(each.t, "x", true);
        row = at - last < 95 * devicePixelRatio ? row + 1 : 0;
        last = at;
        mark(u, ctx, each.t, named ? markName(record.marks, n) : "", row);
      }
    };
    const common = { zero: () => 0, sync: key, onSelect: (/** @type {number} */ from, /** @type {number} */ to) => { x = [from, to]; draw(); },
      onCursor: (/** @type {any} */ u) => {
        const n = u.cursor.idx;
        setReadout(n === null || n === undefined || !(u.cursor.left >= 0) ? "" : `${fixed(record.t[n], 2)} s · PV ${fixed(record.pv[n], decimals)}${record.model ? ` · model ${fixed(record.model[n], decimals)}` : ""} · SP ${fixed(record.sp[n], decimals)} · MV ${fixed(record.mv[n], 1)} %`);
      } };
    const plots = [
      makePlot(pv.current, { ...common, height: 210, withTime: false, lines: [{ label: "PV", colour: record.model ? "measured" : "pv", width: record.model ? 3 : 1.5 }, { label: "SP", colour: "sp", dash: [6, 4], width: 1.2, stepped: true }, { label: "model", colour: "new", width: 1.3 }], above: (u, ctx) => marks(u, ctx, true) }),
      ...(record.model && left.current ? [makePlot(left.current, { ...common, height: 76, withTime: false, lines: [{ label: "left", colour: "measured", width: 1 }],
        beneath: (u, ctx) => {
          if (!record.noise) return;
          const top = u.valToPos(2 * record.noise, "y", true);
          ctx.fillStyle = colour("band");
          ctx.fillRect(u.bbox.left, top, u.bbox.width, u.valToPos(-2 * record.noise, "y", true) - top);
        } })] : []),
      makePlot(mv.current, { ...common, height: 120, withTime: true, lines: [{ label: "MV", colour: "mv", stepped: true }], above: (u, ctx) => marks(u, ctx, false) }),
    ];
    const empty = record.t.map(() => NaN);
    const draw = () => {
      plots[0].show([record.t, record.pv, record.sp, record.model ?? empty], x, yRange([record.pv, record.sp], loop.sp_deviation * 0.5));
      if (plots.length === 3) plots[1].show([record.t, record.left], x, yRange([record.left], 6 * (record.noise || 1e-6)));
      plots[plots.length - 1].show([record.t, record.mv], x, yRange([record.mv], 10));
    };
    draw();
    const whole = () => { x = all; draw(); };
    for (const each of [pv.current, mv.current]) each.addEventListener("dblclick", whole);
    const unsubscribe = shown.subscribe(() => plots.forEach((each) => each.redraw()));
    return () => {
      unsubscribe();
      for (const each of plots) each.destroy();
    };
  }, [record]);
  return html`<section class="card" aria-label="Record" style=${{ marginTop: "16px" }}>
    <div class="split" key="top"><h2 class="title">What was measured${record?.model ? ", and the model found" : ""}</h2><span class="readout">${readout || (record ? "drag to zoom, double click for the whole" : "")}</span>
      <span class="legend" aria-hidden="true"><span class=${record?.model ? "measured" : "pv"}>PV measured</span><span class="sp">SP</span>${record?.model && html`<span class="new">model</span>`}<span class="mv">MV</span></span></div>
    ${!record && html`<p class="quiet" key="words" role="status">${words}</p>`}
    ${record && html`<div key="plots"><span class="axis-name">PV, ${unit(loop.pv_unit)}</span><div class="plot" ref=${pv} role="img" aria-label="PV measured, set-point and model"></div>
      ${record.model && html`<span key="n" class="axis-name">residual, with the noise at rest (2 σ)</span><div key="p" class="plot" ref=${left} role="img" aria-label="What the model leaves"></div>`}
      <span class="axis-name">MV, %</span><div class="plot" ref=${mv} role="img" aria-label="MV"></div><p class="axis-name num">plant time since the test began</p></div>`}
  </section>`;
}

/** The record as columns for a plot: of a bin of several samples its smallest and its largest value. @param {any} found */
export function columns(found) {
  const it = { t: /** @type {number[]} */ ([]), pv: /** @type {number[]} */ ([]), sp: /** @type {number[]} */ ([]), mv: /** @type {number[]} */ ([]), left: /** @type {number[]} */ ([]), model: /** @type {number[] | null} */ (found.explained ? [] : null),
    noise: found.noise ?? 0, marks: found.marks.map((/** @type {any} */ each) => ({ t: each.at_s, stage: each.stage })) };
  const put = (/** @type {number} */ n, /** @type {number} */ t, /** @type {"min" | "max"} */ which) => {
    it.t.push(t);
    it.pv.push(found[`pv_${which}`][n] ?? NaN);
    it.mv.push(found[`mv_${which}`][n] ?? NaN);
    it.sp.push(found.sp[n] ?? NaN);
    it.model?.push(found.explained.model[n] ?? NaN);
    it.left.push(found.explained?.[`residual_${which}`][n] ?? NaN);
  };
  const gap = (/** @type {number} */ t) => {
    it.t.push(t);
    for (const column of [it.pv, it.mv, it.sp, it.left, ...(it.model ? [it.model] : [])]) column.push(NaN);
  };
  for (let n = 0; n < found.at_s.length; n++) {
    if (found.gap_before[n] && n) gap((found.until_s[n - 1] + found.at_s[n]) / 2); // no line across samples that are missing
    put(n, found.at_s[n], "min");
    if (found.until_s[n] > found.at_s[n]) put(n, found.until_s[n], "max");
  }
  return it;
}
