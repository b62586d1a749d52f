// @ts-check
/** The one live stream of a page: opened anew with back-off, given up while the page is hidden. */
import { batch } from "../vendor/signals-core.js";
import { forgetHeard } from "./aborting.js";
import { ask, crowded, signedOut } from "./api.js";
import {
  alarms, buses, forgetRows, jobs, loops, newerVersion, now_s, clock_s, refreshLoops, service, setClock, silent_s, takeRows,
} from "./state.js";
import { Windows } from "./windows.js";

const SILENT_S = 2.5;
/** A stream that is open and has said nothing for so long is opened anew: its connection may be dead, which nobody says. */
const DEAD_S = 10;
const HIDDEN_S = 60;
const LONGEST_WAIT_S = 15;

/** @typedef {{samples?: (found: any) => void, job?: (found: any) => void}} Listener */

/** Whether the page shows another lock than the stream says: one that came and went between two looks of the service is in no row. @param {any} row */
function locksDiffer(row) {
  const shown = loops.value?.get(row.tag);
  return shown !== undefined && (shown.locked?.since ?? null) !== (row.locked_since ?? null);
}

class Stream {
  constructor() {
    /** @type {EventSource | null} */
    this.source = null;
    this.tag = "";
    this.back_s = 10;
    /** @type {Set<Listener>} */
    this.listeners = new Set();
    this.heard_ms = performance.now();
    this.opened_ms = performance.now();
    this.tries = 0;
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    this.retry = undefined;
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    this.hidden = undefined;
    this.given_up = false;
    /** Whether the stream was away: another process of the service may answer, with other loops. */
    this.away = false;
    /** Whether it goes on while the page is hidden. */
    this.stays = false;
    this.jobs_seen = "";
    this.differing = "";
    /** Counts how often the stream was opened. */
    this.opened = 0;
    this.windows = new Windows(
      () => this.source !== null && !this.given_up,
      () => {
        if (document.hidden && !this.stays) this.giveUp();
      },
    );
  }

  begin() {
    this.open();
    setInterval(() => this.tick(), 500);
    document.addEventListener("visibilitychange", () => this.seen());
    // A command that waits in the browser for a connection takes that of the stream, which waits behind it.
    crowded.subscribe((count) => {
      if (count && !this.given_up) this.open();
    });
  }

  /** The loop whose samples and events are wanted. @param {string} tag @param {number} back_s @param {Listener} listener */
  watch(tag, back_s, listener) {
    this.listeners.add(listener);
    this.tag = tag;
    this.back_s = back_s;
    this.open();
    return () => {
      this.listeners.delete(listener);
      if (this.tag === tag && this.listeners.size === 0) {
        this.tag = "";
        this.open();
      }
    };
  }

  open() {
    if (signedOut.value) return;
    clearTimeout(this.retry);
    this.source?.close();
    const query = this.tag ? `?loops=${encodeURIComponent(this.tag)}&back_s=${this.back_s}` : "";
    this.opened++;
    this.opened_ms = performance.now();
    const source = new EventSource(`/live${query}`);
    this.source = source;
    this.windows.opened();
    /** @param {string} name @param {(found: any) => void} take */
    const on = (name, take) =>
      source.addEventListener(name, (event) => {
        if (source !== this.source) return;
        this.heard();
        take(JSON.parse(/** @type {MessageEvent} */ (event).data));
      });
    on("hello", (found) => {
      if (service.value && service.value.version !== found.version) newerVersion.value = true;
      else service.value = { gateway: found.gateway, version: found.version };
      setClock(found.now_s);
      if (!this.away) return;
      this.away = false;
      forgetHeard();
      void refreshLoops();
    });
    on("loops", (found) => {
      setClock(found.now_s);
      takeRows(found.loops);
      const seen = found.loops.map((/** @type {any} */ row) => `${row.tag}${row.job}${row.last_job?.url}${row.last_job?.state}`).join();
      if (seen !== this.jobs_seen || found.loops.some(locksDiffer)) {
        this.jobs_seen = seen;
        void refreshLoops();
      }
    });
    on("buses", (found) => (buses.value = found.buses));
    on("jobs", (found) => (jobs.value = found.jobs));
    on("alarms", (found) => {
      alarms.value = found.alarms;
      const differing = found.alarms.filter((/** @type {any} */ each) => each.kind === "gains_differ").map((/** @type {any} */ each) => each.id).join();
      if (differing === this.differing) return;
      this.differing = differing;
      void refreshLoops();
    });
    on("samples", (found) => this.listeners.forEach((each) => each.samples?.(found)));
    on("job", (found) => this.listeners.forEach((each) => each.job?.(found)));
    source.addEventListener("error", () => {
      if (source !== this.source) return;
      source.close(); // it would give up for good after an HTTP error, and never say which
      this.later();
    });
  }

  /** Gives the stream up for good. */
  end() {
    clearTimeout(this.retry);
    this.source?.close();
    this.source = null;
  }

  later() {
    this.away = true;
    this.tries++;
    const wait_s = Math.min(LONGEST_WAIT_S, 0.5 * 2 ** (this.tries - 1)) * (0.8 + 0.4 * Math.random());
    clearTimeout(this.retry);
    this.retry = setTimeout(async () => {
      try {
        await ask("/session"); // says 401 where the session is over or the key was revoked
        if (this.tag && !signedOut.value) await refreshLoops(); // there is no stream of a loop that is not configured any more
      } catch {
        // The stream says more.
      }
      if (!signedOut.value && !this.given_up) this.open();
    }, wait_s * 1000);
  }

  heard() {
    this.heard_ms = performance.now();
    this.tries = 0;
    if (silent_s.value) silent_s.value = 0;
  }

  tick() {
    const quiet_s = (performance.now() - this.heard_ms) / 1000;
    batch(() => {
      now_s.value = Date.now() / 1000 + clock_s;
      if (!this.given_up) silent_s.value = quiet_s > SILENT_S ? Math.max(1, Math.floor(quiet_s)) : 0;
    });
    const open_s = (performance.now() - this.opened_ms) / 1000;
    if (!this.given_up && this.source && this.source.readyState !== EventSource.CLOSED && Math.min(quiet_s, open_s) > DEAD_S) {
      this.away = true;
      this.open();
    }
  }

  /** Gives the stream up until the page is seen again. */
  giveUp() {
    this.given_up = true;
    this.away = true;
    this.source?.close();
    clearTimeout(this.retry);
    forgetRows(); // what is shown first when the page is seen again is not what was heard long ago
  }

  seen() {
    clearTimeout(this.hidden);
    if (document.hidden) {
      this.hidden = setTimeout(() => {
        if (!this.stays) this.giveUp();
      }, HIDDEN_S * 1000);
    } else if (this.given_up) {
      this.given_up = false;
      this.heard_ms = performance.now();
      this.open();
    }
  }
}

export const stream = new Stream();
