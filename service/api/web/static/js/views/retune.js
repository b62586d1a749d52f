// @ts-check
/** The form of a retune: what will happen, before it starts. */
import { useEffect, useRef, useState } from "../../vendor/hooks.js";
import { ask, askWith, command } from "../api.js";
import { html } from "../html.js";
import { duration, entered, fixed, known, ms, pvDecimals, significant, unit, withUnit } from "../numbers.js";
import { jobPath } from "../router.js";
import { isSilent, rowOf, sign, signature } from "../state.js";
import { sentence, stageName } from "../words.js";

/** Obstacles that a test looks at again for itself before it gives up: it may be started. */
const PASSING = ["not_at_rest"];
/** What the preview says is of a moment: it is asked for again, sooner where something stands in the way. */
const [SOON_MS, LATER_MS] = [5000, 30_000];

/** @param {{loop: any, onClose: (() => void) | null, onStarted: (job: any) => void}} props */
export function RetuneForm({ loop, onClose, onStarted }) {
  const [form, setForm] = useState(/** @type {Record<string, any>} */ ({ method: "fast", Ms: 1.6 }));
  const [more, setMore] = useState(false);
  const [methods, setMethods] = useState(/** @type {any[]} */ ([]));
  const [preview, setPreview] = useState(/** @type {any} */ (null));
  const [unclear, setUnclear] = useState(/** @type {any} */ (null));
  const [refused, setRefused] = useState(/** @type {any} */ (null));
  const [sending, setSending] = useState(false);
  const first = useRef(/** @type {HTMLElement | null} */ (null));
  const row = rowOf(loop.tag).value;
  const { body, bad } = bodyOf(form);
  const asked = JSON.stringify(body);
  const situation = `${row?.mode} ${row?.no_data ? "silent" : ""} ${loop.locked?.since ?? ""}`;

  const inTheWay = !!unclear || !!preview?.obstacles.length;
  const problem = refused ?? unclear;

  useEffect(() => {
    first.current?.focus({ preventScroll: true });
    const escape = (/** @type {KeyboardEvent} */ event) => {
      if (event.key === "Escape") onClose?.();
    };
    addEventListener("keydown", escape);
    return () => removeEventListener("keydown", escape);
  }, []);
  useEffect(() => {
    if (more && !methods.length) void ask("/methods").then(setMethods, () => {});
  }, [more]);
  useEffect(() => {
    if (bad) return;
    const stop = new AbortController();
    const url = `/loops/${encodeURIComponent(loop.tag)}/retune/preview`;
    const look = async (changed = false) => {
      try {
        // how far PV goes takes a computation: what else is known does not wait for it
        if (changed) setPreview({ ...(await askWith(`${url}?pv=false`, JSON.parse(asked), stop.signal)), computing: true });
        setPreview(await askWith(url, JSON.parse(asked), stop.signal));
        setUnclear(null);
      } catch (error) {
        if (!stop.signal.aborted) setUnclear(error);
      }
    };
    const timer = setTimeout(() => void look(true), 200);
    const again = setInterval(() => {
      if (!document.hidden && !isSilent.peek()) void look();
    }, inTheWay ? SOON_MS : LATER_MS);
    return () => {
      clearTimeout(timer);
      clearInterval(again);
      stop.abort();
    };
  }, [asked, bad, situation, inTheWay]);
  useEffect(() => setRefused(null), [asked]);

  const set = (/** @type {string} */ name) => (/** @type {any} */ event) => {
    const { type, checked, value } = event.target;
    setForm({ ...form, [name]: type === "checkbox" ? checked : value });
  };
  const start = async () => {
    setSending(true);
    setRefused(null);
    try {
      onStarted(await command(`/loops/${encodeURIComponent(loop.tag)}/retune`, { ...body, by: signature.value.trim() }));
    } catch (error) {
      setRefused(error);
      setSending(false);
    }
  };
  const designed = form.method === "fast" || form.method === "setpoint";
  const obstacle = preview?.obstacles.find((/** @type {any} */ each) => !PASSING.includes(each.reason));
  const unsigned = !signature.value.trim();
  const why = isSilent.value ? "The service is offline." : bad ? bad : obstacle ? "" : unsigned ? "Your name is missing." : "";
  const dead = sending || !!why || !!obstacle;
  const u = unit(loop.pv_unit);
  return html`<section class="card" aria-label="Retune" style=${{ marginTop: "16px" }}>
    <div class="split" key="top"><h2 class="title">Retune</h2>${onClose && html`<button class="plain" aria-label="Close the form" onClick=${onClose}>✕</button>`}</div>
    <div class="two" key="two"><div class="explain" aria-live="polite">${preview ? What(preview, loop) : html`<p class="quiet">Asking what would happen…</p>`}</div>
      <div>${designed && html`<label key="ms" class="field"><span>Robustness asked for <b>Ms ${ms(Number(form.Ms))}</b></span>
        <input ref=${first} type="range" min="1.2" max="2" step="0.05" value=${form.Ms} onInput=${set("Ms")} aria-valuetext=${`Ms ${ms(Number(form.Ms))}`} /></label>
        <div class="ends" key="ends"><span>1.2 robust</span><span>1.6</span><span>fast 2.0</span></div>`}
        <button key="more" class="plain" aria-expanded=${String(more)} onClick=${() => setMore(!more)}>${more ? "Fewer options" : "More options"}</button></div></div>
    ${more && html`<div class="options" key="options">
      <label class="field"><span>Procedure</span><select class="wide" value=${form.method} onChange=${set("method")}>
        <option value="fast">fast: one record</option><option value="setpoint">set-point pulses</option><option value="five-stage">five-stage</option>
        ${methods.filter((each) => !["fast", "setpoint", "five-stage", "observe"].includes(each.method)).map((each) => html`<option key=${each.method} value=${each.method}>${each.title ?? each.method}</option>`)}</select></label>
      ${form.method === "fast" && Field("amplitude_pct", "%", preview?.first_mv_move_pct, form, set, problem)}
      ${Field("mv_low", "%", loop.mv_limits.low, form, set, problem)}${Field("mv_high", "%", loop.mv_limits.high, form, set, problem)}
      ${Field("pv_low", u, loop.pv_limits.low, form, set, problem)}${Field("pv_high", u, loop.pv_limits.high, form, set, problem)}
      ${Field("sp_deviation", u, loop.sp_deviation, form, set, problem)}
      ${designed && html`<label class="check"><input type="checkbox" checked=${!!form.derivative} onChange=${set("derivative")} /> allow derivative (PID)</label>`}
      ${designed && html`<label class="field"><span>Tuning objective</span><select class="wide" value=${form.aim ?? "balanced"} onChange=${set("aim")}>
        <option value="balanced">set-point and load alike</option><option value="setpoint">set-point steps</option><option value="load">load disturbances</option><option value="no_overshoot">both, without overshoot</option></select></label>`}
      ${designed && Field("settling_s", "s", null, form, set, problem)}
      ${designed && Field("mv_peak", `% per ${u}`, null, form, set, problem)}
      ${form.method === "fast" && html`<label class="field"><span>Relay switches, at least</span><select value=${form.min_switches ?? "4"} onChange=${set("min_switches")}>${["4", "6", "8", "10"].map((each) => html`<option key=${each} value=${each}>${each}</option>`)}</select></label>`}
      <label class="check"><input type="checkbox" checked=${!!form.dry_run} onChange=${set("dry_run")} /> rehearsal: computed in memory, nothing is moved</label>
    </div>`}
    ${preview?.obstacles.map((/** @type {any} */ each) => html`<div class="refusal" key=${each.reason}><p>${asNamed(each.detail)} <span class="advice">${each.advice}</span> ${each.job && html`<a href=${jobPath(each.job)}>to that job</a>`}</p></div>`)}
    ${problem && html`<div class="refusal" role="alert" key="problem"><p>${asNamed(problem.message)} <span class="advice">${problem.advice}</span> ${problem.job && html`<a href=${jobPath(problem.job)}>to that job</a>`}</p></div>`}
    <div class="foot" key="foot"><label class="left">Your name <input type="text" maxlength="100" autocomplete="name" value=${signature.value} onInput=${(/** @type {any} */ e) => sign(e.target.value)} onKeyDown=${(/** @type {any} */ e) => { if (e.key === "Enter" && !dead) void start(); }} /></label>
      <span class="quiet" role="status">${why}</span>
      <button class="main" disabled=${dead} onClick=${start}>${form.dry_run ? "Rehearse" : "Retune"} ${loop.tag}</button></div>
  </section>`;
}

/** @param {string} name @param {string} u @param {number | null | undefined} usual @param {any} form @param {any} set @param {any} problem */
function Field(name, u, usual, form, set, problem) {
  const wrong = problem?.errors?.find((/** @type {any} */ each) => each.where.endsWith(name)) || Number.isNaN(entered(form[name] ?? ""));
  return html`<label class="field" key=${name}><span>${LABELS[name]}</span><span><input type="text" inputmode="decimal" value=${form[name] ?? ""} placeholder=${known(usual) ? significant(usual) : ""} aria-invalid=${wrong ? "true" : undefined} onInput=${set(name)} /> ${u}</span></label>`;
}

/** How the form names the fields of a request. @type {Record<string, string>} */
const LABELS = {
  amplitude_pct: "Relay up by", mv_low: "MV not below", mv_high: "MV not above", pv_low: "Abort below", pv_high: "Abort above",
  sp_deviation: "SP step", settling_s: "Settling time (5 %), at most", mv_peak: "Largest output move",
};

/** A message of the service, with the fields named as the form names them. @param {string | null | undefined} text */
function asNamed(text) {
  return sentence((text ?? "").replace(/\b[a-z]+(?:_[a-z]+)+\b/g, (name) => (LABELS[name] ? `“${LABELS[name]}”` : name)));
}

const NUMBERS = ["mv_low", "mv_high", "pv_low", "pv_high", "sp_deviation"];
const REQUIREMENTS = ["settling_s", "mv_peak"];

/** The body of a request, and what is wrong with the fields. @param {Record<string, any>} form */
function bodyOf(form) {
  /** @type {Record<string, any>} */
  const body = { method: form.method };
  /** @type {string[]} */
  const wrong = [];
  const designed = form.method === "fast" || form.method === "setpoint";
  const names = [...NUMBERS, ...(designed ? REQUIREMENTS : []), ...(form.method === "fast" ? ["amplitude_pct"] : [])];
  for (const name of names) {
    const value = entered(String(form[name] ?? ""));
    if (Number.isNaN(value)) wrong.push(LABELS[name]);
    else if (value !== null) body[name] = value;
  }
  if (designed) {
    body.Ms = Number(form.Ms);
    if (form.derivative) body.derivative = true;
    if (form.aim) body.aim = form.aim;
  }
  if (form.method === "fast" && form.min_switches) body.min_switches = Number(form.min_switches);
  if (form.dry_run) body.dry_run = true;
  const bad = wrong.length ? `Not a number: ${wrong.map((each) => `“${each}”`).join(", ")}.` : "";
  return { body, bad };
}

/** What will happen, in the loop's own numbers. @param {any} p @param {any} loop */
function What(p, loop) {
  if (p.dry_run) return p.summary.map((/** @type {string} */ line) => html`<p key=${line}>${line}</p>`);
  const decimals = pvDecimals(loop.pv_limits);
  const stage = (/** @type {string} */ name) => p.stages.find((/** @type {any} */ each) => each.stage === name);
  const relay = stage("relay");
  const pulses = stage("pulses");
  const manual = stage("manual");
  const verify = stage("verify");
  const step = verify ?? stage("zn_pi");
  const pv = (/** @type {number} */ value) => withUnit(fixed(value, decimals), loop.pv_unit);
  const moving = p.stages.filter((/** @type {any} */ each) => each.mv_move_pct || each.sp_move);
  const hasPv = (/** @type {any} */ each) => known(each.pv_low) && known(each.pv_high);
  return html`<p key="what">The loop is tested around where it is now.
      ${pulses && html` The set-point is pulsed by <b>${pv(pulses.sp_move)}</b> under the present gains.`}
      ${manual && html` The loop stays in manual: the manual output is pulsed, and returns each time. The new gains are <b>not tested</b>.`}
      ${relay && html` ${pulses ? "Where that tells too little, a relay switches MV" : "A relay switches MV"} up and down a few times.`}
      ${step && known(step.sp_move) && step.sp_move > 0 && html` Then the set-point steps by <b>${pv(step.sp_move)}</b>${verify ? " under the new gains" : ""}.`}</p>
    <p key="goes">${known(p.mv_low_pct) && html`MV moves between <b>${fixed(p.mv_low_pct, 0)} and ${fixed(p.mv_high_pct, 0)} %</b> (present ${fixed(p.mv, 0)} %). `}${known(p.pv_low)
      ? html`PV is expected between <b>${fixed(p.pv_low, decimals)} and ${pv(p.pv_high)}</b>, by ${p.pv_known_by}.`
      : moving.some(hasPv)
        ? html`How far PV goes is known of some stages alone, by ${p.pv_known_by}: ${moving.filter(hasPv).map((/** @type {any} */ each, /** @type {number} */ n) => html`${n ? ", " : ""}${stageName(each.stage)} <b>${fixed(each.pv_low, decimals)} to ${pv(each.pv_high)}</b>`)}.`
        : p.computing ? "How far PV goes is being computed…" : "How far PV goes is not known beforehand: no model of this loop tells it."}</p>
    <p key="ends">It ends by itself if PV leaves <b>${fixed(p.watched.pv.low, Math.min(3, decimals))} … ${pv(p.watched.pv.high)}</b>, if anybody else moves the loop, or when you abort. Then, as at its end, the loop has its mode, ${manual ? "manual output" : "set-point"} and gains back. New gains are a proposal until you accept them.</p>
    <p key="time" class="quiet">It takes ${duration(p.duration_low_s)} to ${duration(p.duration_high_s)} of plant time, estimated from ${p.duration_basis}.</p>`;
}
