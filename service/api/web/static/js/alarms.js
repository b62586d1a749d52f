// @ts-check
/** The active alarms: what the service says, and that it says nothing, which this browser alone can know. */
import { computed } from "../vendor/signals-core.js";
import { alarms, isSilent, now_s, silent_s } from "./state.js";

/**
 * As GET /alarms has them.
 * @typedef {{id: string, priority: 1 | 2 | 3, kind?: string, gateway?: string, subject: string, text: string, advice: string, since: string, loop: string | null,
 *   loops: string[], job: string | null, unacknowledged: boolean}} Alarm
 */

const silence = computed(() => {
  if (!isSilent.value) return null;
  return /** @type {Alarm} */ ({
    id: "silent", priority: 2, subject: "this browser", text: "Service offline",
    advice: "What is shown is old. The page asks again by itself.",
    since: new Date(1000 * (now_s.peek() - silent_s.peek())).toISOString(), loop: null, loops: [], job: null, unacknowledged: false,
  });
});

/** The worst first; null: the service has not said yet. */
export const activeAlarms = computed(() => {
  const said = /** @type {Alarm[] | null} */ (alarms.value);
  if (silence.value) return [silence.value, ...(said ?? [])];
  return said;
});

/** The worst alarm of each loop, by tag. */
export const worstOf = computed(() => {
  /** @type {Map<string, Alarm>} */
  const found = new Map();
  for (const each of activeAlarms.value ?? []) for (const tag of each.loops) if (!found.has(tag)) found.set(tag, each);
  return found;
});
