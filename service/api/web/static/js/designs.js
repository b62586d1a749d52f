// @ts-check
/** The gains from robust to fast that the service has designed on a job's model, asked for once and kept. */
import { signal } from "../vendor/signals-core.js";
import { ask } from "./api.js";

/** @type {Map<string, {found: import("../vendor/signals-core.js").Signal<{ms: number, gains: any, uncertainty: number | null}[]>, state: import("../vendor/signals-core.js").Signal<"" | "asked" | "done">}>} */
const kept = new Map();

/** @param {string} job its URL */
export function designsOf(job) {
  let it = kept.get(job);
  if (!it) kept.set(job, (it = { found: signal(/** @type {any[]} */ ([])), state: signal(/** @type {"" | "asked" | "done"} */ ("")) }));
  return it;
}

/** Asks for them, if they are not known. @param {string} job @param {AbortSignal} stop */
export async function fillDesigns(job, stop) {
  const it = designsOf(job);
  if (it.state.value === "done") return;
  it.state.value = "asked";
  try {
    const answer = await ask(`${job}/designs`, stop);
    it.found.value = answer.designs
      .filter((/** @type {any} */ each) => each.gains)
      .map((/** @type {any} */ each) => ({ ms: each.Ms_asked, gains: each.gains, uncertainty: each.uncertainty }));
    it.state.value = "done";
  } catch (error) {
    if (stop.aborted) return;
    const { status } = /** @type {any} */ (error);
    it.state.value = status === 404 || status === 409 || status === 422 ? "done" : "";
  }
}
