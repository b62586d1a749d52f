// @ts-check
/** What a job's gains do on its model, and the gains from robust to fast: the service's, asked for once and kept. */
import { signal } from "../vendor/signals-core.js";
import { ask } from "./api.js";

/**
 * @typedef {{horizon_s: number, pv: number[]}} StepCurve PV after a unit step, at times evenly spaced
 * @typedef {{setpoint: StepCurve, load: StepCurve, nyquist_re: number[], nyquist_im: number[]}} Curves
 * @typedef {{ms: number, gains: any, uncertainty: number | null, performance: any, beside: string | null, curves: Curves | null}} Design
 * @typedef {{designs: Design[], previous: any, new: any, previous_curves: Curves | null, new_curves: Curves | null, new_beside: string | null}} Found
 */

/** @type {Map<string, {found: import("../vendor/signals-core.js").Signal<Found | null>, state: import("../vendor/signals-core.js").Signal<"" | "asked" | "done">}>} */
const kept = new Map();

/** @param {string} job its URL */
export function designsOf(job) {
  let it = kept.get(job);
  if (!it) kept.set(job, (it = { found: signal(/** @type {Found | null} */ (null)), state: signal(/** @type {"" | "asked" | "done"} */ ("")) }));
  return it;
}

/** Asks for them, if they are not known. @param {string} job @param {AbortSignal} stop */
export async function fillDesigns(job, stop) {
  const it = designsOf(job);
  if (it.state.value === "done") return;
  it.state.value = "asked";
  try {
    const answer = await ask(`${job}/designs`, stop);
    const designs = answer.designs
      .filter((/** @type {any} */ each) => each.gains && each.performance)
      .map((/** @type {any} */ each) => ({ ...each, ms: each.Ms_asked }));
    it.found.value = { ...answer, designs };
    it.state.value = "done";
  } catch (error) {
    if (stop.aborted) return;
    const { status } = /** @type {any} */ (error);
    it.state.value = status === 404 || status === 409 || status === 422 ? "done" : "";
  }
}
