// @ts-check
/** Numbers, units and times as text. What is not known is a dash, never a zero. Pure: the present is handed in. */

export const DASH = "–";
const NARROW = "\u202f";
const MINUS = "\u2212";

/** @param {unknown} value @returns {value is number} */
export function known(value) {
  return typeof value === "number" && Number.isFinite(value);
}

/** @param {string} text */
function signed(text) {
  return text.startsWith("-") ? (Number(text) === 0 ? text.slice(1) : MINUS + text.slice(1)) : text;
}

/** A number with so many decimals. @param {number | null | undefined} value @param {number} decimals */
export function fixed(value, decimals) {
  return known(value) ? signed(value.toFixed(decimals)) : DASH;
}

/**
 * The decimals of PV and SP: a thousandth of the permitted range shows.
 * @param {{low: number, high: number}} limits
 */
export function pvDecimals(limits) {
  const step = (limits.high - limits.low) / 1000;
  return step > 0 ? Math.min(6, Math.max(0, Math.ceil(-Math.log10(step) - 1e-9))) : 2;
}

/** Significant digits; an exponent only below 1e-4 and from 1e6. @param {number | null | undefined} value */
export function significant(value, digits = 4) {
  if (!known(value)) return DASH;
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-4 || size >= 1e6)) return signed(value.toExponential(digits - 1).replace("e-", `e${MINUS}`).replace("e+", "e"));
  if (size === 0) return "0";
  const decimals = digits - 1 - Math.floor(Math.log10(size));
  return signed(value.toFixed(Math.max(0, Math.min(12, decimals))));
}

/** Ms with two decimals. @param {number | null | undefined} value */
export function ms(value) {
  return fixed(value, 2);
}

/** An error with one digit; of Ms never less than 0.001. @param {number | null | undefined} value */
export function msError(value) {
  return known(value) ? Math.max(0.001, value).toFixed(3) : DASH;
}

/** @param {number | null | undefined} value @param {number | null | undefined} error */
export function withError(value, error) {
  if (!known(error) || error === 0) return significant(value);
  return `${significant(value)} ± ${significant(error, 1)}`;
}

/** @type {Record<string, string>} */
const UNITS = { degC: "°C", degF: "°F", "m3/h": "m³/h", m3: "m³", "m3/s": "m³/s", "kg/m3": "kg/m³", "m2": "m²", uS: "µS" };

/** @param {string} name */
export function unit(name) {
  return UNITS[name] ?? name;
}

/** @param {string} text @param {string} of */
export function withUnit(text, of) {
  return `${text}${NARROW}${of === "%" ? "%" : unit(of)}`;
}

/** A duration: 9.4 s, 50 s, 14 min, 2.3 h, 3 d. @param {number | null | undefined} seconds */
export function duration(seconds) {
  if (!known(seconds)) return DASH;
  const s = Math.max(0, seconds);
  if (s < 9.95) return `${s.toFixed(1)}${NARROW}s`;
  if (s < 99.5) return `${s.toFixed(0)}${NARROW}s`;
  if (s < 99.5 * 60) return `${(s / 60).toFixed(s < 595 ? 1 : 0)}${NARROW}min`;
  if (s < 48 * 3600) return `${(s / 3600).toFixed(1)}${NARROW}h`;
  return `${(s / 86400).toFixed(0)}${NARROW}d`;
}

/** A sampling period: 50 ms, 0.25 s. @param {number | null | undefined} seconds */
export function period(seconds) {
  if (!known(seconds)) return DASH;
  return seconds < 0.2 ? `${Number((seconds * 1000).toPrecision(3))}${NARROW}ms` : `${Number(seconds.toPrecision(3))}${NARROW}s`;
}

/** @param {number} value */
const two = (value) => String(value).padStart(2, "0");

/** Date and time of day, local. @param {string | null | undefined} iso */
export function when(iso) {
  if (!iso) return DASH;
  const d = new Date(iso);
  if (Number.isNaN(d.getTime())) return DASH;
  return `${d.getFullYear()}-${two(d.getMonth() + 1)}-${two(d.getDate())} ${two(d.getHours())}:${two(d.getMinutes())}`;
}

/** The time of day of a wall time, local. @param {number} at_s */
export function timeOfDay(at_s) {
  const d = new Date(at_s * 1000);
  return `${two(d.getHours())}:${two(d.getMinutes())}:${two(d.getSeconds())}`;
}

/** How long ago: "3 min ago". @param {string | null | undefined} iso @param {number} now_s */
export function ago(iso, now_s) {
  if (!iso) return DASH;
  const seconds = now_s - new Date(iso).getTime() / 1000;
  if (!Number.isFinite(seconds)) return DASH;
  return seconds < 5 ? "just now" : `${duration(Math.max(10, seconds)).replace(/\.\d(?=\u202fmin)/, "")} ago`;
}

/** A change in percent. @param {number | null | undefined} before @param {number | null | undefined} after */
export function change(before, after) {
  if (!known(before) || !known(after) || before === 0) return "";
  const percent = Math.round((after / before - 1) * 100);
  return `${percent > 0 ? "+" : ""}${signed(String(percent))}${NARROW}%`;
}

/** What a field says; a decimal comma is taken. @param {string} text @returns {number | null} */
export function entered(text) {
  const cleaned = text.trim().replace(",", ".").replace(MINUS, "-");
  if (cleaned === "") return null;
  const value = Number(cleaned);
  return Number.isFinite(value) ? value : NaN;
}

/** The name of an axis' tick, with the decimals that the distance of the ticks needs. @param {number} value @param {number} distance */
export function tick(value, distance) {
  const decimals = Math.min(6, Math.max(0, Math.ceil(-Math.log10(distance) - 1e-9)));
  return signed(value.toFixed(decimals));
}
