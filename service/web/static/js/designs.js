// @ts-check
/** The gains that the service designs on a job's record for other Ms, asked for one after the other and kept. */
import { signal } from "../vendor/signals-core.js";
import { ask } from "./api.js";

const ORDER = [1.4, 2.0, 1.2, 1.8, 1.3, 1.5, 1.7, 1.9, 1.6];

/** @type {Map<string, {found: import("../vendor/signals-core.js").Signal<{ms: number, gains: any, uncertainty: number | null}[]>, asked: boolean}>} */
const kept = new Map();

/** @param {string} job its URL */
export function designsOf(job) {
  let it = kept.get(job);
  if (!it) kept.set(job, (it = { found: signal(/** @type {any[]} */ ([])), asked: false }));
  return it;
}

/** Asks for those that are missing. @param {string} job @param {AbortSignal} stop */
export async function fillDesigns(job, stop) {
  const it = designsOf(job);
  for (const ms of ORDER) {
    if (stop.aborted) return;
    if (it.found.value.some((each) => each.ms === ms)) continue;
    try {
      const answer = await ask(`${job}/alternatives?ms=${ms}`, stop);
      const found = answer.methods[0];
      if (found?.outcome === "tuned") it.found.value = [...it.found.value, { ms, gains: found.gains, uncertainty: found.uncertainty }].sort((a, b) => a.ms - b.ms);
    } catch (error) {
      if (stop.aborted) return;
      const { status } = /** @type {any} */ (error);
      if (status === 404 || status === 409 || status === 422) return;
    }
  }
}
