// @ts-check
/** The words for stages, states and reasons. */
import { fixed, known, significant, unit, withUnit, duration, ms, msError } from "./numbers.js";

/** @type {Record<string, [name: string, what: string]>} */
const STAGES = {
  preflight: ["Steady-state check", "Is the loop at rest, and how large is the noise?"],
  settle: ["Settling", "The loop comes to rest first"],
  pulses: ["Set-point pulses", "The set-point is pulsed under the present gains, until what would be proposed is certain"],
  manual: ["Manual-output pulses", "The manual output is pulsed, until what would be proposed is certain"],
  relay: ["Relay test", "MV is switched up and down until what would be proposed is certain"],
  design: ["Model and gains", "A model is fitted to the record, and gains are designed on it"],
  verify: ["Set-point step, new gains", "The set-point steps under the new gains"],
  redesign: ["Final model", "The model is fitted anew to all that was recorded"],
  baseline: ["Set-point step, previous gains", "The set-point steps under the previous gains"],
  ultimate: ["Ultimate gain", "The gain at which the loop oscillates is sought"],
  zn_pi: ["Ziegler-Nichols PI", "The set-point steps under a Ziegler-Nichols PI"],
  estimate: ["FOPDT estimate", "A model of first order with dead time is estimated from the step"],
  optimise: ["Optimisation", "The gains are computed on the model"],
};
/** @param {string | null | undefined} stage */
export const stageName = (stage) => (stage ? (STAGES[stage]?.[0] ?? stage.replaceAll("_", " ")) : "");
/** @param {string} stage */
export const stageWhat = (stage) => STAGES[stage]?.[1] ?? "";

/** The stages that a request leads to, in order. @param {any} job */
export function stagesOf(job) {
  const done = job.stages.map((/** @type {any} */ each) => each.stage);
  const { method, request } = job;
  /** @type {string[]} */
  let expected;
  if (method === "fast" && request.start === "design") expected = ["preflight", "design", "verify"];
  else if (method === "setpoint") expected = ["preflight", "pulses", "design", "verify", "redesign"];
  else if (done.includes("manual") || (method === "fast" && job.mode_found === "manual")) expected = ["preflight", "manual", "design"];
  else if (method === "fast") expected = ["preflight", done.includes("pulses") && !done.includes("relay") ? "pulses" : "relay", "design", "verify", "redesign"];
  else expected = ["preflight", ...(request.baseline === false ? [] : ["baseline"]), "relay", "ultimate", "zn_pi", "estimate", "optimise", "verify"];
  if (request.verify === false) expected = expected.filter((each) => each !== "verify" && each !== "redesign");
  const seen = [...new Set(done)];
  const last = Math.max(-1, ...seen.map((each) => expected.indexOf(each)));
  return [...seen, ...expected.slice(last + 1).filter((each) => !seen.includes(each))];
}

/** What a stage found, in a few words. @param {any} stage @param {string} pv */
export function stageFound(stage, pv) {
  const r = stage.result ?? {};
  const lines = [];
  if (known(r.noise) && stage.stage === "preflight") lines.push(`noise ${withUnit(significant(r.noise, 2), pv)}`);
  if (known(r.switches) && stage.stage === "relay") lines.push(`${r.switches} switches`, `period ${withUnit(significant(r.period_s, 3), "s")}`);
  if (known(r.amplitude) && stage.stage === "relay") lines.push(`MV ±${fixed(r.amplitude, 0)} %`);
  if (known(r.Ku)) lines.push(`Ku ${significant(r.Ku)} %/${unit(pv)}`);
  if (known(r.Pu_s)) lines.push(`Pu ${withUnit(significant(r.Pu_s), "s")}`);
  const gains = r.gains ?? (stage.stage === "verify" ? {} : r);
  if (known(r.Ms) && stage.stage !== "verify") lines.push(`Ms ${ms(r.Ms)}${known(r.uncertainty) ? ` ± ${msError(r.uncertainty)}` : ""}`);
  if (known(gains.Kp)) lines.push(`Kp ${significant(gains.Kp)}, Ti ${withUnit(significant(gains.Ti ?? gains.Ti_s), "s")}${weight(gains)}`);
  if (known(r.fit_pct)) lines.push(`${fixed(r.fit_pct, 1)} % explained`);
  if (known(r.overshoot_pct)) lines.push(`overshoot ${fixed(r.overshoot_pct, 0)} %`);
  if (known(r.settling_s)) lines.push(`settled in ${duration(r.settling_s)}`);
  return lines.slice(0, 4);
}

/** The set-point weight b, where it is not one. @param {any} gains */
export function weight(gains) {
  return known(gains?.b) && gains.b !== 1 ? `, b ${significant(gains.b, 3)}` : "";
}

/**
 * The name of a mark in a picture of a record. A step that follows a relay or pulses does not begin at rest.
 * @param {{stage: string}[]} marks @param {number} n
 */
export function markName(marks, n) {
  const name = stageName(marks[n].stage);
  const before = marks[n].stage === "verify" && n > 0 ? { relay: "the relay", pulses: "the pulses" }[marks[n - 1].stage === "design" ? (marks[n - 2]?.stage ?? "") : marks[n - 1].stage] : undefined;
  return before ? `Set-point step, from where ${before} left PV` : name;
}

/** The set-point weight that was on the loop, where that of the gains proposed is larger and was not. @param {any} job @returns {number | null} */
export function untriedWeight(job) {
  const tried = job.verification?.b ?? 1;
  return job.verification && known(job.new_gains?.b) && job.new_gains.b > Math.max(1, tried) ? tried : null;
}

/** @type {Record<string, string>} */
const REASONS = {
  operator: "by an operator",
  service_stopped: "the service ended",
  setpoint_changed: "set-point changed",
  setpoint_is_driven: "set-point is driven by another controller",
  pv_limit: "PV left its limits",
  mv_limit: "MV at its limit",
  node_lost: "node lost",
  node_not_answering: "node does not answer",
  bus_lost: "bus lost",
  gateway_lost: "gateway does not answer",
  internal: "an error inside the service",
};
/** @param {string | null | undefined} reason */
export const reasonWords = (reason) => (reason ? (REASONS[reason] ?? reason.replaceAll("_", " ")) : "");

/** What became of a decision that was asked at another gateway than the loop's. @param {any} request @param {string} gateway the loop's */
export function decisionRequestWords(request, gateway) {
  const what = `${request.what === "accept" ? "Accepting" : "Rolling back"}, asked by ${request.by} at gateway ${request.gateway}`;
  switch (request.state) {
    case "waiting": return `${what}: gateway ${gateway} has not begun it yet.`;
    case "under_way": return `${what}: gateway ${gateway} is at it.`;
    case "refused": return `${what}, was not done: ${request.detail ?? "an error there"}.`;
    case "cut_off": return `${what}, was cut off: whether the gains were written is not known. Look at the gains in effect, then decide again.`;
    default: return `${what}, was not done: gateway ${gateway} did not answer in time, and will not do it any more.`;
  }
}

/** The headline of a job. @param {any} job */
export function headline(job) {
  const why = reasonWords(job.reason);
  switch (job.state) {
    case "queued": return "Queued";
    case "running": return job.stopping ? "Aborting, the loop is being restored" : "Under test";
    case "proposed": return job.superseded_by ? "Proposed, not decided; a later job came" : "New gains are proposed";
    case "accepted": return "Accepted";
    case "rolled_back": return "Rolled back to the previous gains";
    case "no_gain": return "No improvement: the loop is tuned as well as asked";
    case "rehearsed": return "Rehearsed: gains found without a test of the loop";
    case "refused": return `Refused: ${why}`;
    case "aborted": return `Aborted: ${why}`;
    case "failed": return `Failed: ${why}`;
    case "interrupted": return `Interrupted: ${why || "the service ended in the middle"}`;
    default: return String(job.state).replaceAll("_", " ");
  }
}

/** A state in a table. @param {any} job */
export function stateWords(job) {
  switch (job.state) {
    case "proposed": return job.superseded_by ? "not decided; a later job came" : "awaiting decision";
    case "rolled_back": return "rolled back";
    case "no_gain": return "no improvement";
    case "refused": return `refused: ${reasonWords(job.reason)}`;
    case "aborted": return `aborted: ${reasonWords(job.reason)}`;
    case "failed": return `failed: ${reasonWords(job.reason)}`;
    case "queued": return "queued";
    case "running": return "under test";
    default: return String(job.state).replaceAll("_", " ");
  }
}

/** @type {Record<string, string>} */
const MODES = { automatic: "AUTO", manual: "MAN", off: "OFF", experiment: "TEST" };
/** @param {string | null | undefined} mode */
export const modeWord = (mode) => (mode ? (MODES[mode] ?? mode.toUpperCase()) : "–");

/** What the service says, as a sentence. @param {string | null | undefined} text */
export const sentence = (text) => (text ? text[0].toUpperCase() + text.slice(1) + (/[.!?]$/.test(text) ? "" : ".") : "");

/** @param {string} method */
export const methodName = (method) => method.replaceAll("-", " ");
