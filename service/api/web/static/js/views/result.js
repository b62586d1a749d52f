// @ts-check
/** The result of a job: headline, how far to trust it, before and after, what the loop is now, the record. */
import { html } from "../html.js";
import { duration, fixed, known, ms, msError, pvDecimals, significant, unit, when, withError, withUnit } from "../numbers.js";
import { jobPath } from "../router.js";
import { headline, methodName, sentence } from "../words.js";
import { Choice } from "./choice.js";
import { Record } from "./record.js";
import { Stages } from "./undertest.js";
import { Watch } from "./watch.js";

/**
 * @param {{loop: any, detail: any, job: any, quiet?: boolean, own?: boolean, onChanged: (job: any) => void}} props
 * quiet: another question is open. own: the page of the job itself.
 */
export function Result({ loop, detail, job, quiet = false, own = false, onChanged }) {
  const trust = trustWords(job);
  const latest = loop.last_job?.url === job.url;
  return html`<section aria-label="Result">
    <div class="headline" key="head"><div><h2>${headline(job)}</h2>${trust && html`<p>${trust}</p>`}</div>
      <p class="facts">${when(job.ended_at ?? job.created_at)} · ${job.by} · ${methodName(job.method)} · ${duration(job.plant_time_s)} of plant time<br />
        ${job.decided && html`${job.decided.what === "accept" ? "accepted" : job.monitoring ? "previous gains put back" : "previous gains kept"} by ${job.decided.by}, ${when(job.decided.at)} · `}
        <a href=${`${job.url}/report`} target="_blank">Report</a><a href=${`${job.url}/samples?format=csv`} target="_blank">Samples</a>${!own && html`<a href=${jobPath(job.url)}>job ${job.id}</a>`}</p></div>
    ${job.reason && html`<div class="card" key="why"><p>${sentence(job.detail)}</p><p class="advice">${job.advice}</p>${After(loop, job)}</div>`}
    ${job.superseded_by && html`<p class="refusal" key="later">A later job came: <a href=${jobPath(job.superseded_by)}>its result</a>.</p>`}
    ${job.new_gains && html`<${Choice} key="choice" loop=${loop} detail=${detail} job=${job} latest=${latest} quiet=${quiet} onChanged=${onChanged} />`}
    ${job.monitoring && html`<${Watch} key="watch" loop=${loop} job=${job} onChanged=${onChanged} />`}
    ${!["fast", "setpoint"].includes(job.method) || own ? html`<div class="card" key="stages" style=${{ marginTop: "16px" }}><h2 class="title">Stages</h2>${Stages(job, loop.pv_unit)}</div>` : null}
    ${job.record === "kept" && html`<${Record} key="record" loop=${loop} job=${job} />`}
    ${job.record === "deleted" && html`<p key="deleted" class="quiet">The samples of this test were deleted as old ones are; its result stays.</p>`}
    ${Numbers(loop, job)}
    ${job.notes.length > 0 && html`<div class="card" key="notes"><h2 class="title">Notes</h2>${job.notes.map((/** @type {string} */ each) => html`<p key=${each}>${sentence(each)}</p>`)}</div>`}
  </section>`;
}

/** How far to trust it. @param {any} job */
function trustWords(job) {
  if (!job.new_gains) return null;
  const parts = [];
  if (job.verification) parts.push(html`The model explains <b>${fixed(job.verification.fit_pct, 1)} %</b> of the measured step. `);
  if (job.evidence) parts.push(html`Ms <b>${ms(job.predicted?.Ms ?? job.evidence.Ms)}</b>${known(job.evidence.uncertainty) ? html`, known to within ${msError(job.evidence.uncertainty)}` : ""}. `);
  if (known(job.evidence?.longest_delay_seen_s)) parts.push(html`What MV does more than ${duration(job.evidence.longest_delay_seen_s)} later than the rest would not show in this test. `);
  if (job.tested_on_loop === false) parts.push(html`The new gains were <b>never tested</b> on this loop. `);
  if (job.rehearsed_on) parts.push(html`Computed on ${job.rehearsed_on.plant_text}; the loop was not moved. `);
  if (job.step_after && !job.verification) parts.push(html`Measured with the new gains: overshoot <b>${fixed(job.step_after.overshoot_pct, 0)} %</b>, ${job.step_after.settled ? `settled in ${duration(job.step_after.settling_s)}` : "not settled"}. `);
  if (!job.evidence && known(job.predicted?.Ms)) parts.push(html`Ms <b>${ms(job.predicted.Ms)}</b> on the model. `);
  return parts.length ? parts : null;
}

/** What the loop is now. @param {any} loop @param {any} job */
function After(loop, job) {
  const r = job.restored;
  if (!r) return html`<p><b>The loop could not be read back: look at the controller.</b></p>`;
  return html`<p class="quiet">The loop was left in ${r.mode}${r.mode === "manual" ? ` at MV ${withUnit(fixed(r.manual_output, 1), "%")}` : ""}, set-point ${withUnit(fixed(r.sp, pvDecimals(loop.pv_limits)), unit(loop.pv_unit))}${r.gains ? `, Kp ${significant(r.gains.Kp)}, Ti ${significant(r.gains.Ti)} s` : ""}, read back.</p>`;
}

/** Names of the parameters of a model; the report has the same. @type {Record<string, string>} */
const PARAMETERS = {
  K: "process gain K", Kv: "velocity gain Kv", T: "time constant T", T1: "time constant T1", T2: "time constant T2",
  zeta: "damping", Tz: "zero, time constant Tz", L: "dead time L",
};

/** @param {any} loop @param {any} job */
function Numbers(loop, job) {
  const u = unit(loop.pv_unit);
  /** @type {[string, any][]} */
  const rows = [];
  const m = job.model;
  const list = (/** @type {number[]} */ values, /** @type {number[] | null} */ errors) => values.map((value, n) => withError(value, errors?.[n])).join(", ");
  if (m?.num) {
    rows.push(["model", m.structure === "typed in" ? "given with the request" : m.integrating ? `integrating as far as the record shows (${m.structure})` : m.structure]);
    for (const each of m.parameters) rows.push([PARAMETERS[each.name], each.unit ? withUnit(withError(each.value, each.error), each.unit.replace("PV", u).replace("MV", "%")) : withError(each.value, each.error)]);
    if (!m.parameters.length) rows.push(["numerator", list(m.num, m.num_errors)], ["denominator", list(m.den, m.den_errors)], ["dead time L", withUnit(withError(m.dead_time_s, m.dead_time_error_s), "s")]);
  }
  else if (m) rows.push(["model", `K ${significant(m.K)} ${u}/%, T ${significant(m.T_s)} s, dead time ${significant(m.L_s)} s${known(m.zeta) ? `, damping ${significant(m.zeta)}` : ""}`]);
  if (known(m?.fit_pct)) rows.push(["fit", `${fixed(m.fit_pct, 1)} %`]);
  if (job.ultimate) rows.push(["ultimate point", `Ku ${significant(job.ultimate.Ku)} %/${u}, Pu ${significant(job.ultimate.Pu_s)} s`]);
  if (job.evidence) rows.push(["excitation", `${job.evidence.switches} switches, period ${significant(job.evidence.period_s)} s`], ["residual", known(job.evidence.residual) ? `${fixed(job.evidence.residual, 2)} times the noise at rest` : "–"]);
  for (const [name, value] of Object.entries(job.design)) rows.push([name, significant(Number(value))]);
  if (job.step_before) rows.push(["step, previous gains", `overshoot ${fixed(job.step_before.overshoot_pct, 0)} %, ${job.step_before.settled ? `settled in ${duration(job.step_before.settling_s)}` : "not settled"}`]);
  if (job.step_after) rows.push(["step, new gains", `overshoot ${fixed(job.step_after.overshoot_pct, 0)} %, ${job.step_after.settled ? `settled in ${duration(job.step_after.settling_s)}` : "not settled"}`]);
  if (job.restored && !job.reason) rows.push(["loop afterwards", `${job.restored.mode}, SP ${withUnit(fixed(job.restored.sp, pvDecimals(loop.pv_limits)), u)}, read back`]);
  rows.push(["gateway", job.gateway]);
  return html`<div class="card" key="numbers"><h2 class="title">Numbers</h2><dl class="numbers">${rows.map(([name, value]) => html`<div key=${name}><dt>${name}</dt><dd>${value}</dd></div>`)}</dl></div>`;
}
