// @ts-check
/** What many places of the page show, as signals. */
import { batch, computed, signal } from "../vendor/signals-core.js";
import { ask, askAll, csrf } from "./api.js";

/** Who is signed in: name, scope (read, operate, admin), whether keys are asked for. null: not known yet. */
export const session = signal(/** @type {{name: string, scope: string, keys: boolean} | null} */ (null));
/** The service that answers: its name, its version. */
export const service = signal(/** @type {{gateway: string, version: string} | null} */ (null));
/** Another version than the one this page was loaded from. */
export const newerVersion = signal(false);

/** The configured loops, by tag. null: not known yet. */
export const loops = signal(/** @type {Map<string, any> | null} */ (null));
export const loopsError = signal(/** @type {Error | null} */ (null));

/** Rows of the live stream, by tag: one signal each, so that a row is drawn for itself. @type {Map<string, any>} */
const rows = new Map();
/** @param {string} tag @returns {import("../vendor/signals-core.js").Signal<any>} the live row of a loop; null: none has come. */
export function rowOf(tag) {
  let found = rows.get(tag);
  if (!found) rows.set(tag, (found = signal(null)));
  return found;
}
/** @param {any[]} found */
export function takeRows(found) {
  batch(() => {
    for (const row of found) rowOf(row.tag).value = row;
  });
}

/** What was heard of the loops is not known any more. */
export function forgetRows() {
  batch(() => {
    for (const row of rows.values()) row.value = null;
  });
}

export const buses = signal(/** @type {{gateway: string, bus: string, up: boolean | null, why: string | null}[]} */ ([]));
/** Live jobs. */
export const jobs = signal(/** @type {any[]} */ ([]));
/** The active alarms, as the service says, the worst first; null: it has not said yet. */
export const alarms = signal(/** @type {any[] | null} */ (null));

/** The present, wall time of the service, s, renewed each second. */
export const now_s = signal(Date.now() / 1000);
/** Service's clock minus browser's, s. */
export let clock_s = 0;
/** @param {number} at_s */
export function setClock(at_s) {
  clock_s = at_s - Date.now() / 1000;
  now_s.value = at_s;
}

/** Whole seconds without a word from the service; 0: it speaks. */
export const silent_s = signal(0);
export const isSilent = computed(() => silent_s.value > 0);

export const may = {
  operate: computed(() => ["operate", "admin"].includes(session.value?.scope ?? "")),
  admin: computed(() => session.value?.scope === "admin"),
};

/** The name under which the person signs; kept in this browser. */
export const signature = signal(read("loopwright.signature"));
/** @param {string} name */
export function sign(name) {
  signature.value = name;
  write("loopwright.signature", name);
}
/** @param {string} key */
export function read(key) {
  try {
    return localStorage.getItem(key) ?? "";
  } catch {
    return "";
  }
}
/** @param {string} key @param {string} value */
export function write(key, value) {
  try {
    localStorage.setItem(key, value);
  } catch {
    // A browser that keeps nothing asks again.
  }
}

let asking = false;
let again = false;
/** Asks for the loops; a call while one is under way asks once more afterwards. */
export async function refreshLoops() {
  if (asking) {
    again = true;
    return;
  }
  asking = true;
  try {
    do {
      again = false;
      const found = await askAll("/loops?limit=1000");
      batch(() => {
        loops.value = new Map(found.map((each) => [each.tag, each]));
        loopsError.value = null;
      });
    } while (again);
  } catch (error) {
    loopsError.value = /** @type {Error} */ (error);
  } finally {
    asking = false;
  }
}

/** Asks who is signed in, and for what a change shows beside the cookie. */
export async function refreshSession() {
  try {
    const found = await ask("/session");
    csrf.value = found.csrf ?? "";
    session.value = { name: found.name, scope: found.scope, keys: found.keys };
  } catch {
    // After 401 the sign-in view is shown; the stream says when the service is silent.
  }
}
