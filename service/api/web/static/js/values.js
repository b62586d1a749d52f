// @ts-check
/** The values of a loop as they are shown: present ones, or those heard last, which are grey and have their age. Pure. */
import { duration } from "./numbers.js";

/**
 * old: whether they are not present ones.
 * @typedef {{pv: number | null, sp: number | null, mv: number | null, mode: string | null, old: boolean, age_s: number | null}} Values
 */

/** @type {Values} */
const NONE = { pv: null, sp: null, mv: null, mode: null, old: false, age_s: null };

/** Nothing of a service that is silent. @param {any} row of the live stream, null: none has come @param {boolean} silent @returns {Values} */
export function valuesOf(row, silent) {
  if (!row || silent) return NONE;
  const { pv, sp, mv, mode } = row.no_data !== null && row.last ? row.last : row;
  return { pv, sp, mv, mode, old: row.no_data !== null, age_s: row.age_s };
}

/** How old values are that are old, in words; empty: they are present ones, or there are none. @param {Values} values */
export function ageWords(values) {
  const known = values.pv !== null || values.sp !== null || values.mv !== null;
  return values.old && known && values.age_s !== null ? `${duration(values.age_s)} old` : "";
}
