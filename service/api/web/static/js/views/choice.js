// @ts-check
/** Before and after: what can be had between robust and fast, steps, Nyquist, the table, and the decision. */
import { useEffect, useRef, useState } from "../../vendor/hooks.js";
import { ask, command } from "../api.js";
import { designsOf, fillDesigns } from "../designs.js";
import { html } from "../html.js";
import { change, fixed, known, ms as msText, msError, pvDecimals, significant, unit, withUnit } from "../numbers.js";
import { isSilent, may, refreshLoops, rowOf, sign, signature } from "../state.js";
import { decisionRequestWords, untriedWeight, weight } from "../words.js";
import { Curve, NyquistPlot, StepPlot } from "./figures.js";

const LOAD_PCT = 10;
/** Between the small figures, pixels; the third is 0.8 times as wide as the others (app.css). */
const GAP = 16;

/** @param {{loop: any, detail: any, job: any, latest: boolean, quiet: boolean, onChanged: (job: any) => void}} props */
export function Choice({ loop, detail, job, latest, quiet, onChanged }) {
  const designed = (job.method === "fast" || job.method === "setpoint") && !job.dry_run;
  const tested = job.design.Ms ?? job.predicted?.Ms ?? Number(job.request.Ms ?? 1.6);
  const [ms, setMs] = useState(/** @type {number} */ (tested));
  const { found: foundSignal, state } = designsOf(job.url);
  const found = foundSignal.value;
  const asked = state.value === "asked";
  const curve = useRef(/** @type {HTMLElement | null} */ (null));
  const [width, setWidth] = useState(760);
  useEffect(() => {
    if (!curve.current) return;
    const watch = new ResizeObserver(([entry]) => setWidth(Math.max(240, Math.round(entry.contentRect.width))));
    watch.observe(curve.current);
    return () => watch.disconnect();
  }, [job.id]);
  useEffect(() => {
    const stop = new AbortController();
    void fillDesigns(job.url, stop.signal);
    return () => stop.abort();
  }, [job.id]);
  const old = job.comparison?.previous ?? found?.previous ?? null;
  /** @type {import("../designs.js").Design} */
  const own = {
    ms: tested, gains: job.new_gains, uncertainty: job.evidence?.uncertainty ?? null,
    performance: job.comparison?.new ?? found?.new ?? null, curves: found?.new_curves ?? null,
    beside: found?.new_beside ?? null,
  };
  const designs = [...(designed ? (found?.designs ?? []).filter((each) => Math.abs(each.ms - tested) > 0.02) : []), own].sort((a, b) => a.ms - b.ms);
  const chosen = designs.find((each) => Math.abs(each.ms - ms) < 1e-9) ?? own;
  const atTested = chosen === own;
  const size = Math.abs(job.verification?.step || job.step_after?.step || loop.sp_deviation);
  const points = designs.filter((each) => each.performance?.load?.IAE > 0).map((each) => ({ ms: each.ms, IAE: each.performance.load.IAE }));
  const name = nameOf(job);
  const narrow = matchMedia("(max-width: 720px)").matches;
  const small = narrow ? width : (width - 2 * GAP) / 2.8;
  const [before, after] = [found?.previous_curves ?? null, chosen.curves];
  const Ms = chosen.performance?.Ms ?? chosen.ms;
  const decided = job.state === "accepted" || job.state === "rolled_back"; // its verdict speaks of the gains before as the present ones
  const verdict = atTested && !decided ? job.comparison?.verdict : chosen.beside;

  return html`<div class="card choice"><div class="body"><div ref=${curve}>
      ${designed && html`<div class="curve" key="curve"><div class="split"><span class="title">Robustness</span><span>Ms <b>${msText(ms)}</b> <span class="quiet">${atTested ? testedWords(job) : "not tested"}</span></span></div>
        ${Curve(width, points, ms, tested, old?.Ms ?? null, old?.stable ? (old.load?.IAE ?? null) : null)}
        <input type="range" min=${designs[0].ms} max=${designs[designs.length - 1].ms} step="0.01" value=${ms} disabled=${designs.length < 2} aria-label="Ms" aria-valuetext=${`Ms ${msText(ms)}, ${atTested ? testedWords(job) : "not tested"}`}
          onInput=${(/** @type {any} */ e) => setMs(nearest(designs, Number(e.target.value)))}
          onDblClick=${() => setMs(tested)} onKeyDown=${(/** @type {any} */ e) => slide(e, tested, designs, setMs)} />
        <div class="ends"><span>${msText(designs[0].ms)} robust</span>${asked && html`<span class="quiet">asking for the designs…</span>`}<span>fast ${msText(designs[designs.length - 1].ms)}</span></div></div>`}
      ${after && html`<div class="small-plots" key="plots">
        <figure><figcaption><b>Set-point step</b> PV, ${unit(loop.pv_unit)}, by the model</figcaption>${StepPlot(small, before?.setpoint ?? null, after.setpoint, size, true, "Set-point step, previous and new gains")}</figure>
        <figure><figcaption><b>Load step of ${LOAD_PCT} %</b> PV, ${unit(loop.pv_unit)}</figcaption>${StepPlot(small, before?.load ?? null, after.load, LOAD_PCT, false, "Load step, previous and new gains")}</figure>
        <figure><figcaption><b>Distance from −1</b> Nyquist</figcaption>${NyquistPlot(narrow ? small : 0.8 * small, before, after, Ms)}</figure></div>
        <div class="legend" key="legend" style=${{ marginTop: "8px" }}><span class="old">previous</span><span class="new">${atTested ? name : "chosen"}</span></div>`}
      ${!after && html`<p class="quiet" key="no-plots">${asked ? "asking for the curves…" : state.value === "done" ? "The service has no curves for these gains." : ""}</p>`}
    </div><div>${Table(loop, job, chosen, old, atTested, size, found)}${!job.reason && verdict && html`<p class="note" key="verdict">${verdict}</p>`}</div></div>
    ${!quiet && html`<${Decide} key="decide" loop=${loop} detail=${detail} job=${job} latest=${latest} ms=${ms} tested=${tested} atTested=${atTested} back=${() => setMs(tested)} onChanged=${onChanged} />`}
  </div>`;
}

/** What of the gains found was on the loop. @param {any} job */
function testedWords(job) {
  if (!job.verification && !job.step_after) return "as asked";
  const b = untriedWeight(job);
  return b === null ? "as asked and tested" : `as asked; tested with b ${significant(b, 3)}`;
}

/** The Ms of the design that is nearest. @param {import("../designs.js").Design[]} designs @param {number} ms */
function nearest(designs, ms) {
  return designs.reduce((best, each) => (Math.abs(each.ms - ms) < Math.abs(best - ms) ? each.ms : best), designs[0].ms);
}

/** What the gains are that were found. @param {any} job */
const nameOf = (job) => (["proposed", "accepted", "rolled_back"].includes(job.state) ? "proposed" : "found");

/** From one design to the next. @param {any} e @param {number} tested @param {import("../designs.js").Design[]} designs @param {any} setMs */
function slide(e, tested, designs, setMs) {
  const move = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1 }[/** @type {string} */ (e.key)];
  if (e.key === "Escape") {
    e.preventDefault();
    setMs(tested);
  } else if (move) {
    e.preventDefault();
    setMs((/** @type {number} */ ms) => { // a key that repeats comes more often than the page is drawn
      const at = designs.findIndex((each) => Math.abs(each.ms - ms) < 1e-9);
      return designs[Math.min(designs.length - 1, Math.max(0, at + move))].ms;
    });
  }
}

/** What was asked for, beside the name of a figure. @param {number | null | undefined} value */
const atMost = (value) => (known(value) ? `, asked: at most ${significant(Number(value), 3)}` : "");

/** @param {any} loop @param {any} job @param {import("../designs.js").Design} chosen @param {any} was performance before @param {boolean} atTested @param {number} size @param {import("../designs.js").Found | null} found */
function Table(loop, job, chosen, was, atTested, size, found) {
  const u = unit(loop.pv_unit);
  const old = job.previous_gains;
  const gains = chosen.gains;
  const a = was ?? {};
  const b = chosen.performance ?? {};
  const stable = was?.stable ?? true;
  const uncertain = chosen.uncertainty;
  const load = (/** @type {any} */ of) => (known(of.load?.IAE) ? LOAD_PCT * of.load.IAE : null);
  const [dm, dmAfter] = [a.delay_margin_s ?? found?.previous?.delay_margin_s, b.delay_margin_s ?? (atTested ? found?.new?.delay_margin_s : null)];
  /** @type {[any, string, number | null | undefined, number | null | undefined, (v: any) => string][]} */
  const rows = [
    [html`Gain Kp <small>%/${u}</small>`, "kp", old?.Kp, gains.Kp, significant],
    [html`Integral time Ti <small>s</small>`, "ti", old?.Ti, gains.Ti, significant],
    ...(old?.Td || gains.Td ? /** @type {any[]} */ ([[html`Derivative time Td <small>s</small>`, "td", old?.Td, gains.Td, significant]]) : []),
    ...(weight(old) || weight(gains) ? /** @type {any[]} */ ([[html`Set-point weight b`, "b", old?.b, gains.b, (/** @type {any} */ v) => significant(v, 3)]]) : []),
    [html`Overshoot <small>%</small>`, "os", stable ? a.overshoot_pct : null, b.overshoot_pct, (v) => fixed(v, 0)],
    [html`Settling time (5 %) <small>s${atMost(atTested ? job.comparison?.settling_s_asked : null)}</small>`, "settle", stable ? a.setpoint?.settling_s : null, b.setpoint?.settling_s, (v) => significant(v, 2)],
    ...(known(job.comparison?.mv_peak_asked) ? /** @type {any[]} */ ([[html`Largest output move <small>%/${u}${atMost(job.comparison.mv_peak_asked)}</small>`, "mv", stable ? a.setpoint?.mv_peak : null, b.setpoint?.mv_peak, significant]]) : []),
    [html`Load of ${LOAD_PCT} %, IAE <small>${u} s</small>`, "iae", stable ? load(a) : null, load(b), (v) => significant(v, 3)],
    [html`Largest sensitivity Ms ${known(uncertain) && html`<small>± ${msError(uncertain)}</small>`}`, "ms", stable ? a.Ms : null, b.Ms, msText],
    [html`Gain margin`, "gm", stable ? a.GM : null, b.GM, (v) => (known(v) ? `× ${fixed(v, 2)}` : "–")],
    [html`Delay margin <small>s</small>`, "dm", stable ? dm : null, dmAfter, (v) => significant(v, 3)],
    [html`Phase margin <small>°</small>`, "pm", stable ? a.PM_deg : null, b.PM_deg, (v) => fixed(v, 0)],
  ];
  return html`<table class="figures" key="table"><caption class="hidden-words">Previous and new gains, for a set-point step of ${size} ${u}</caption>
    <thead><tr><th><span class="hidden-words">Figure</span></th><th class="num">previous</th><th class="num">${atTested ? nameOf(job) : "chosen"}</th><th><span class="hidden-words">Change</span></th></tr></thead>
    <tbody>${rows.map(([name, key, x, y, text]) => html`<tr key=${key}><td>${name}</td><td class="num">${key === "ti" && x === 0 ? "off" : text(x)}</td><td class="num after">${text(y)}</td><td class="num quiet">${key === "os" ? "" : change(x, y)}</td></tr>`)}</tbody></table>
    ${!stable && html`<p class="note" key="unstable">With the previous gains, the loop is not stable on this model.</p>`}`;
}

/** @param {{loop: any, detail: any, job: any, latest: boolean, ms: number, tested: number, atTested: boolean, back: () => void, onChanged: (job: any) => void}} props */
function Decide({ loop, detail, job, latest, ms, tested, atTested, back, onChanged }) {
  const [asking, setAsking] = useState("");
  const [problem, setProblem] = useState(/** @type {any} */ (null));
  const [sending, setSending] = useState(false);
  const [byItself, setByItself] = useState(true);
  const field = useRef(/** @type {HTMLInputElement | null} */ (null));
  const group = useRef(/** @type {HTMLElement | null} */ (null));
  const asked = useRef("");
  useEffect(() => {
    if (asking) field.current?.focus();
    else if (asked.current) /** @type {HTMLElement | null} */ (group.current?.querySelector(`[data-opens="${asked.current}"]`))?.focus();
    asked.current = asking;
    const escape = (/** @type {KeyboardEvent} */ e) => {
      if (e.key === "Escape") close();
    };
    if (asking) addEventListener("keydown", escape);
    return () => removeEventListener("keydown", escape);
  }, [asking]);
  const close = () => setAsking("");
  const open = (/** @type {string} */ what) => {
    setProblem(null);
    setAsking(what);
  };
  const send = async (/** @type {() => Promise<any>} */ what) => {
    setSending(true);
    setProblem(null);
    try {
      const found = await what();
      if (found?.url === job.url) onChanged(found);
      setAsking("");
      void refreshLoops();
    } catch (error) {
      setProblem(error);
    }
    setSending(false);
  };
  const by = () => ({ by: signature.value.trim() });
  const request = job.decision_request;
  const pending = request && ["waiting", "under_way"].includes(request.state);
  useEffect(() => {
    if (!pending) return;
    const stop = new AbortController();
    const timer = setInterval(() => void ask(job.url, stop.signal).then(onChanged, () => {}), 1000);
    return () => {
      clearInterval(timer);
      stop.abort();
    };
  }, [pending, job.url]);
  const tryIt = () =>
    send(async () => {
      const answer = await ask(`${job.url}/alternatives?Ms=${ms.toFixed(2)}`);
      const body = answer.methods[0]?.retune;
      if (!body) throw new Error(answer.methods[0]?.detail ?? "The service has no gains for this Ms.");
      return command(`/loops/${encodeURIComponent(loop.tag)}/retune`, { ...body, by: signature.value.trim() });
    });
  const dead = sending || isSilent.value;
  const gains = asking === "rollback" ? job.previous_gains : job.new_gains;
  const written = gains && `Kp ${significant(gains.Kp)} %/${unit(loop.pv_unit)}, Ti ${significant(gains.Ti)} s${gains.Td ? `, Td ${significant(gains.Td)} s` : ""}${weight(gains)}`;
  const where = `${loop.tag}, node ${loop.controller_node.toString(16)}h channel ${loop.channel}`;
  const Signed = (/** @type {string} */ action, /** @type {() => void} */ go) => html`<span class="ask" key="ask"><label key="by">Your name <input ref=${field} type="text" maxlength="100" autocomplete="name" value=${signature.value} onInput=${(/** @type {any} */ e) => sign(e.target.value)} onKeyDown=${(/** @type {any} */ e) => { if (e.key === "Enter" && signature.value.trim() && !dead) go(); }} /></label>
    <button key="cancel" onClick=${close}>Cancel</button><button key="go" class="main" disabled=${dead || !signature.value.trim()} onClick=${go}>${action}</button></span>`;
  const mode = rowOf(loop.tag).value?.mode;
  const noTrialIn = mode === "manual" ? "in manual" : mode === "off" ? "off" : "";
  const backButton = html`<button key="back" onClick=${() => { close(); back(); }}>Back to Ms ${msText(tested)}</button>`;
  let inside = null;
  if (job.dry_run) inside = html`<span class="say">A rehearsal: nothing was moved, and there is nothing to accept.</span>`;
  else if (loop.locked) inside = html`<span class="say">Locked by ${loop.locked.by}: no decision until it is unlocked.</span>`;
  else if (!may.operate.value) inside = html`<span class="say">${job.state === "proposed" ? "The loop runs on its previous gains. To accept the new ones needs the scope operate." : ""}</span>`;
  else if (pending) inside = html`<span class="say" role="status">${decisionRequestWords(request, loop.gateway)}</span>`;
  else if (asking === "accept") inside = html`<span class="say">Write <b>${written}</b> into ${where}, for good.</span><label key="itself" class="itself"><input type="checkbox" checked=${byItself} onChange=${(/** @type {any} */ e) => setByItself(e.target.checked)} /> Put the previous gains back automatically if, while the loop is monitored, PV leaves its limits or an oscillation grows</label>${Signed(`Write to ${loop.tag}`, () => send(() => command(`${job.url}/accept`, { ...by(), auto_rollback: byItself })))}`;
  else if (asking === "keep") inside = html`<span class="say">Keep the previous gains; the proposal is declined.</span>${Signed("Keep the previous gains", () => send(() => command(`${job.url}/rollback`, by())))}`;
  else if (asking === "rollback") inside = html`<span class="say">Write the previous gains, <b>${written}</b>, back into ${where}.</span>${Signed(`Roll ${loop.tag} back`, () => send(() => command(`${job.url}/rollback`, by())))}`;
  else if (noTrialIn && (!atTested || asking === "try")) inside = html`<span class="say">These gains have not been on the loop, and cannot be tried: a trial steps the set-point, and the loop is ${noTrialIn}. Put it in automatic to try them.</span>${backButton}`;
  else if (asking === "try") inside = html`<span class="say">A trial listens, steps the set-point by <b>${withUnit(fixed(loop.sp_deviation, pvDecimals(loop.pv_limits)), loop.pv_unit)}</b> under the gains for Ms ${msText(ms)}, and ends as a proposal. No relay.</span>${Signed(`Try Ms ${msText(ms)} on ${loop.tag}`, tryIt)}`;
  else if (!atTested) inside = html`<span class="say">These gains have not been on the loop.</span>${backButton}<button key="try" class="main" disabled=${dead} data-opens="try" onClick=${() => open("try")}>Try Ms ${msText(ms)} on ${loop.tag}…</button>`;
  else if (job.state === "proposed" && latest) inside = html`<span class="say">The loop runs on its previous gains until you accept.</span><button key="keep" disabled=${dead} data-opens="keep" onClick=${() => open("keep")}>Keep the previous gains…</button><button key="accept" class="main" disabled=${dead} data-opens="accept" onClick=${() => open("accept")}>Accept the new gains…</button>`;
  else if (job.state === "accepted" && latest) inside = html`<span class="say">Accepted by <b>${job.decided?.by ?? "–"}</b>${detail?.live ? html`; in effect now: Kp ${significant(detail.live.gains.Kp)}, Ti ${significant(detail.live.gains.Ti)} s${weight(detail.live.gains)}` : ""}.</span><button key="rollback" disabled=${dead} data-opens="rollback" onClick=${() => open("rollback")}>Roll back to the previous gains…</button>`;
  else if (job.state === "rolled_back") inside = html`<span class="say">The loop runs on its previous gains${job.decided ? `; decided by ${job.decided.by}` : ""}.</span>`;
  else if (job.state === "proposed") inside = html`<span class="say">Not decided; a later job came.</span>`;
  else if (job.state === "accepted") inside = html`<span class="say">Accepted by <b>${job.decided?.by ?? "–"}</b>; a later job came.</span>`;
  if (!inside && !problem) return null;
  return html`<div class="decide" ref=${group} role="group" aria-label="Decision">${inside}${request && !pending && !asking && html`<p class="quiet" key="request">${decisionRequestWords(request, loop.gateway)}</p>`}${problem && html`<p class="refusal" role="alert" key="problem">${problem.message} <span class="advice">${problem.advice ?? ""}</span></p>`}</div>`;
}
