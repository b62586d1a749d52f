// @ts-check
/** Paths below /ui/. Links are ordinary; one listener takes plain left clicks. */
import { signal } from "../vendor/signals-core.js";

export const path = signal(location.pathname);

/** @param {string} to */
export function go(to) {
  if (to === location.pathname + location.search) return;
  history.pushState(null, "", to);
  path.value = location.pathname;
  scrollTo(0, 0);
}

export function beginRouting() {
  addEventListener("popstate", () => (path.value = location.pathname));
  addEventListener("click", (event) => {
    if (event.defaultPrevented || event.button || event.metaKey || event.ctrlKey || event.shiftKey || event.altKey) return;
    const link = /** @type {Element} */ (event.target).closest?.("a[href]");
    if (!(link instanceof HTMLAnchorElement) || link.target || link.hasAttribute("download")) return;
    if (link.origin !== location.origin || !link.pathname.startsWith("/ui")) return;
    event.preventDefault();
    go(link.pathname + link.search);
  });
}

/** A part of a path as it was meant; one that was typed in and is no such text stays as it is. @param {string} part */
export function decoded(part) {
  try {
    return decodeURIComponent(part);
  } catch {
    return part;
  }
}

/** @param {string} tag */
export const loopPath = (tag) => `/ui/loops/${encodeURIComponent(tag)}`;
/** The page's path of a job. @param {string} url of the API */
export const jobPath = (url) => `/ui${url}`;
