// @ts-check
/** Requests to the public API. A question is asked again where the service says so; a command is sent once. */
import { signal } from "../vendor/signals-core.js";

/** What the service answered where it did not do what was asked. */
export class Problem extends Error {
  /** @param {number} status @param {any} body @param {number | null} retryAfter_s */
  constructor(status, body, retryAfter_s = null) {
    super(body?.detail ?? body?.title ?? (status ? `The service answers ${status}.` : "The service does not answer."));
    this.status = status;
    /** @type {string | null} */
    this.reason = body?.reason ?? null;
    /** @type {string | null} */
    this.advice = body?.advice ?? null;
    /** @type {string | null} */
    this.job = body?.job ?? null;
    /** @type {{where: string, why: string}[]} */
    this.errors = body?.errors ?? [];
    this.retryAfter_s = retryAfter_s;
  }
}

/** True once an answer was 401: the sign-in view is shown. */
export const signedOut = signal(false);
/** What a change shows beside the cookie of the session; empty: there is no session. */
export const csrf = signal("");
/** Counts answers that were 403: another key may have signed in, in another tab. */
export const forbidden = signal(0);
/**
 * Counts commands that were not answered soon. A browser makes six connections to a service at most, for all of its
 * windows, and the stream of each takes one: with six windows a command would wait in the browser for ever.
 */
export const crowded = signal(0);
const SOON_MS = 1500;
/** A command that is not answered for so long is taken back, if it is still in the browser: nothing begins later. */
const LONGEST_S = 60;

/** @param {string} method @param {string} path @param {unknown} [body] @param {AbortSignal} [stop] */
async function request(method, path, body, stop) {
  /** @type {Record<string, string>} */
  const headers = { Accept: "application/json" };
  if (method !== "GET" && csrf.value) headers["X-Loopwright-CSRF"] = csrf.value;
  if (body !== undefined) headers["Content-Type"] = "application/json";
  let answer;
  try {
    answer = await fetch(path, { method, headers, body: body === undefined ? undefined : JSON.stringify(body), signal: stop });
  } catch (error) {
    if (stop?.aborted) throw error;
    throw new Problem(0, { detail: "The service does not answer." });
  }
  const text = await answer.text();
  let found = null;
  try {
    found = text ? JSON.parse(text) : null;
  } catch {
    found = null;
  }
  if (answer.ok) return { found, headers: answer.headers };
  if (answer.status === 401 && !(method === "POST" && path === "/session")) signedOut.value = true;
  if (answer.status === 403) forbidden.value++;
  const after = Number(answer.headers.get("Retry-After"));
  throw new Problem(answer.status, found, after > 0 ? after : null);
}

/** @param {number} seconds @param {AbortSignal} [stop] */
function pause(seconds, stop) {
  return new Promise((done, failed) => {
    const timer = setTimeout(done, seconds * 1000);
    stop?.addEventListener("abort", () => {
      clearTimeout(timer);
      failed(new DOMException("stopped", "AbortError"));
    });
  });
}

/**
 * Asks; where the service is busy (429, 503 with Retry-After), again, six times at most.
 * @param {string} path @param {AbortSignal} [stop] @returns {Promise<any>}
 */
export async function ask(path, stop) {
  return (await asked(path, stop)).found;
}

/** @param {string} path @param {AbortSignal} [stop] @returns {Promise<{found: any, headers: Headers}>} */
async function asked(path, stop) {
  for (let tries = 1; ; tries++) {
    try {
      return await request("GET", path, undefined, stop);
    } catch (error) {
      if (!(error instanceof Problem) || error.retryAfter_s === null || tries >= 6) throw error;
      await pause(Math.min(error.retryAfter_s, 10), stop);
    }
  }
}

/** Asks for a list with all its pages. @param {string} path @returns {Promise<any[]>} */
export async function askAll(path) {
  /** @type {any[]} */
  const all = [];
  /** @type {string | null} */
  let next = path;
  while (next) {
    /** @type {{found: any, headers: Headers}} */
    const { found, headers } = await asked(next);
    all.push(...found);
    next = /<([^>]+)>;\s*rel="next"/.exec(headers.get("Link") ?? "")?.[1] ?? null;
  }
  return all;
}

/** A page of a list, and the path of the next one. @param {string} path @param {AbortSignal} [stop] */
export async function askPage(path, stop) {
  const { found, headers } = await asked(path, stop);
  return { entries: found, next: /<([^>]+)>;\s*rel="next"/.exec(headers.get("Link") ?? "")?.[1] ?? null };
}

/** A question that has a body. @param {string} path @param {unknown} body @param {AbortSignal} [stop] @returns {Promise<any>} */
export async function askWith(path, body, stop) {
  return (await request("POST", path, body, stop)).found;
}

/**
 * Sends a command, once, and waits for the answer, not longer than `longest_s`.
 * @param {string} path @param {unknown} [body] @param {string} [method] @param {number} [longest_s] @returns {Promise<any>}
 */
export async function command(path, body, method = "POST", longest_s = LONGEST_S) {
  const stop = new AbortController();
  const soon = setTimeout(() => crowded.value++, SOON_MS);
  const late = setTimeout(() => stop.abort(), longest_s * 1000);
  try {
    return (await request(method, path, body, stop.signal)).found;
  } catch (error) {
    if (!stop.signal.aborted) throw error;
    throw new Problem(0, { reason: "not_answered", detail: `The service has not answered within ${longest_s} s: it is not known whether it has received this.` });
  } finally {
    clearTimeout(soon);
    clearTimeout(late);
  }
}
