// @ts-check
/** Abort: one press, no question. It is tried also while the service is silent. */
import { signal } from "../vendor/signals-core.js";
import { command } from "./api.js";
import { signature } from "./state.js";

/** Ids of the jobs that this page has asked to stop. */
export const aborting = signal(/** @type {Set<string>} */ (new Set()));
/** What went wrong, by job. */
export const abortError = signal(/** @type {Map<string, string>} */ (new Map()));

/** @param {{id: string, url: string, loop: string}} job */
export async function abortJob(job) {
  if (aborting.value.has(job.id)) return;
  aborting.value = new Set([...aborting.value, job.id]);
  const errors = new Map(abortError.value);
  errors.delete(job.id);
  abortError.value = errors;
  try {
    await command(`${job.url}/abort`, { by: signature.value || "operators' page" });
  } catch (error) {
    const problem = /** @type {import("./api.js").Problem} */ (error);
    if (problem.status === 409) return; // it was over already
    abortError.value = new Map([...abortError.value, [job.id, `Abort failed: ${problem.message}`]]);
    aborting.value = new Set([...aborting.value].filter((each) => each !== job.id));
  }
}
