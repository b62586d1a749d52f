// @ts-check
/** Abort: one press, no question. It is tried also while the service is silent; what the service has not said is not shown. */
import { signal } from "../vendor/signals-core.js";
import { command, csrf } from "./api.js";
import { isElsewhere } from "./gateways.js";
import { refreshSession, signature } from "./state.js";

const ANSWERED_WITHIN_S = 10;

/** Jobs that this page has asked to stop, by id, and whether the service has said that it has heard it. */
export const aborting = signal(/** @type {Map<string, "asked" | "heard">} */ (new Map()));
/** What went wrong, by job. */
export const abortError = signal(/** @type {Map<string, string>} */ (new Map()));

/** @param {string} id @param {"asked" | "heard" | null} state */
function note(id, state) {
  const found = new Map(aborting.value);
  if (state) found.set(id, state);
  else found.delete(id);
  aborting.value = found;
}

/** Another process of the service may answer: what it knows of aborts, it says itself. */
export function forgetHeard() {
  aborting.value = new Map([...aborting.value].filter(([, state]) => state === "asked"));
}

/**
 * What is said of a job that is to stop; empty: it is not to stop. A gateway that says nothing may not have heard of it.
 * @param {{id: string, stopping: boolean, gateway: string, progress: number | null}} job of the live stream
 */
export function stopWords(job) {
  const asked = aborting.value.get(job.id);
  if (job.stopping || asked === "heard") {
    const silent = isElsewhere(job) && job.progress === null;
    return silent ? `asked to stop, gateway ${job.gateway} has not confirmed it` : "stopping, the loop is being restored";
  }
  return asked ? "abort sent, no answer yet" : "";
}

/** @param {{id: string, url: string, loop: string}} job */
export async function abortJob(job) {
  if (aborting.value.has(job.id)) return;
  note(job.id, "asked");
  const errors = new Map(abortError.value);
  errors.delete(job.id);
  abortError.value = errors;
  try {
    await sendAbort(job);
    note(job.id, "heard");
  } catch (error) {
    const problem = /** @type {import("./api.js").Problem} */ (error);
    if (problem.status === 409) return note(job.id, "heard"); // it was over already
    abortError.value = new Map([...abortError.value, [job.id, notAborted(problem)]]);
    note(job.id, null);
  }
}

/** Why an abort is not known to have been heard. @param {import("./api.js").Problem} problem */
export function notAborted(problem) {
  const unknown = problem.reason === "not_answered" || problem.status >= 500;
  return `Abort ${unknown ? "not confirmed" : "failed"}: ${problem.message}`;
}

/**
 * Sends an abort of a job, or of a batch, and returns what it is after that.
 * @param {{url: string}} what @returns {Promise<any>}
 */
export async function sendAbort(what) {
  const ask = () => command(`${what.url}/abort`, { by: signature.value || "operators' page" }, "POST", ANSWERED_WITHIN_S);
  const shown = csrf.value;
  try {
    return await ask();
  } catch (error) {
    if (/** @type {import("./api.js").Problem} */ (error).status !== 403) throw error;
    await refreshSession(); // somebody has signed in anew in another window of this browser
    if (csrf.value === shown) throw error;
    return await ask();
  }
}
