// @ts-check
/** What is abnormal, as far as this page sees it. Pure, but for the times at which each began. */
import { duration, fixed, pvDecimals, unit } from "./numbers.js";

/** @typedef {{key: string, level: 1 | 2 | 3, loop: string | null, words: string, since_s: number}} Alarm */

const DELAY_S = { 1: 0, 2: 3, 3: 0 };
/** @type {Map<string, {since_s: number, left_s: number | null}>} */
const began = new Map();

/**
 * @param {Iterable<any>} loops as GET /loops has them
 * @param {(tag: string) => any} rowOf
 * @param {{bus: string, up: boolean | null, why: string | null}[]} buses
 * @param {number} now_s
 * @returns {Alarm[]} worst first
 */
export function abnormal(loops, rowOf, buses, now_s) {
  /** @type {Map<string, Omit<Alarm, "since_s">>} */
  const found = new Map();
  /** @param {1|2|3} level @param {string | null} loop @param {string} what @param {string} words */
  const add = (level, loop, what, words) => found.set(`${loop ?? ""}/${what}`, { key: `${loop ?? ""}/${what}`, level, loop, words });
  const down = new Set(buses.filter((each) => each.up === false).map((each) => each.bus));
  for (const each of buses) if (each.up === false) add(2, null, `bus ${each.bus}`, `Bus ${each.bus} is down${each.why ? `: ${each.why}` : ""}`);
  for (const loop of loops) {
    const row = rowOf(loop.tag);
    if (loop.last_job?.reason === "restore_unconfirmed") add(1, loop.tag, "restore", "Not confirmed that the loop is as before the test: look at the controller now");
    if (["failed", "interrupted"].includes(loop.last_job?.state)) add(3, loop.tag, "test", `The last test ${loop.last_job.state === "failed" ? "failed" : "was interrupted"}`);
    if (loop.gains_differ) add(3, loop.tag, "gains", "Gains differ from those accepted last");
    if (!row) continue;
    if (down.has(loop.bus)) add(2, loop.tag, "bus", "Bus down");
    else if (row.not_heard && row.age_s !== null) add(2, loop.tag, "data", `No data for ${duration(row.age_s)}`);
    const decimals = pvDecimals(loop.pv_limits);
    if (row.pv !== null && row.pv < loop.pv_limits.low) add(2, loop.tag, "pv", `PV below ${fixed(loop.pv_limits.low, Math.min(2, decimals))} ${unit(loop.pv_unit)}`);
    if (row.pv !== null && row.pv > loop.pv_limits.high) add(2, loop.tag, "pv", `PV above ${fixed(loop.pv_limits.high, Math.min(2, decimals))} ${unit(loop.pv_unit)}`);
    if ((row.on_trial || row.under_test) && !row.job) add(2, loop.tag, "trial", row.on_trial ? "Gains on trial that no job here has begun" : "A test that no job here has begun");
  }
  for (const [key, each] of began) {
    if (found.has(key)) each.left_s = null;
    else if (each.left_s === null) each.left_s = now_s;
    else if (now_s - each.left_s > 3) began.delete(key);
  }
  /** @type {Alarm[]} */
  const shown = [];
  for (const [key, each] of found) {
    const seen = began.get(key) ?? { since_s: now_s, left_s: null };
    began.set(key, seen);
    if (now_s - seen.since_s >= (key.endsWith("/trial") ? 5 : DELAY_S[each.level])) shown.push({ ...each, since_s: seen.since_s });
  }
  return shown.sort((a, b) => a.level - b.level || (a.loop ?? "").localeCompare(b.loop ?? ""));
}
