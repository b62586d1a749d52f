// @ts-check
/** What stands on every view: the bar, the banner, the dock with Abort. */
import { signal } from "../../vendor/signals-core.js";
import { abortJob, abortError, stopWords } from "../aborting.js";
import { activeAlarms } from "../alarms.js";
import { command, signedOut } from "../api.js";
import { html } from "../html.js";
import { duration } from "../numbers.js";
import { cyclePalette, palette } from "../palette.js";
import { loopPath, path } from "../router.js";
import { isSilent, jobs, may, newerVersion, service, session, silent_s } from "../state.js";
import { AlarmSymbol } from "../symbols.js";
import { stageName } from "../words.js";
import { keysShown } from "./keys.js";

const PLACES = [["/ui/", "Loops"], ["/ui/jobs", "Jobs"], ["/ui/batches", "Batches"]];

export function Bar() {
  const at = path.value;
  const inside = (/** @type {string} */ to) => (to === "/ui/" ? at === "/ui/" || at.startsWith("/ui/loops") : at.startsWith(to));
  const all = activeAlarms.value;
  const counts = /** @type {const} */ ([1, 2, 3]).map((priority) => [priority, (all ?? []).filter((each) => each.priority === priority).length]);
  const some = counts.filter(([, count]) => count);
  return html`<header class="bar">
    <a class="mark" href="/ui/" aria-label="Loopwright, to the loops"><svg viewBox="0 0 32 18" aria-hidden="true"><path d="M1 15h7c4 0 4-12 9-12 3 0 3 5 6 5h8" /></svg><span>Loopwright</span></a>
    <nav aria-label="Views">
      ${PLACES.map(([to, name]) => html`<a key=${to} href=${to} aria-current=${inside(to) ? "page" : undefined}>${name}</a>`)}
      ${may.admin.value && html`<a key="log" href="/ui/log" aria-current=${inside("/ui/log") ? "page" : undefined}>Log</a>`}
    </nav>
    <div class="right">
      <a href="/ui/alarms"><span class="hidden-words">${!all ? "Alarms" : some.length ? `${all.length} active ${all.length === 1 ? "alarm" : "alarms"}: ` : ""}</span>
        ${some.length ? some.map(([priority, count]) => html`<span key=${priority} class="count">${AlarmSymbol(/** @type {1|2|3} */ (priority))} ${count}</span>`) : html`<svg class="calm-sign" viewBox="0 0 20 20" aria-hidden="true"><path d="M10 2.5 18 17H2Z" class="s-line" /></svg><span class="calmness">${all ? "No active alarms" : "…"}</span>`}
      </a>
      <span class="who">${session.value && html`${service.value && service.value.gateway !== session.value.name ? `${service.value.gateway} · ` : ""}<b>${session.value.name}</b> · ${session.value.scope}`}</span>
      <button class="plain" onClick=${() => (keysShown.value = !keysShown.value)} aria-label="Keys" aria-keyshortcuts="?" title="keys of this page">?</button>
      <button class="plain" onClick=${cyclePalette} aria-label=${`Colours: ${palette.value}`}>◑ <span class="who">${palette.value}</span></button>
      ${signOutError.value && html`<span key="error" role="alert">${signOutError.value}</span>`}
      ${session.value?.keys && html`<button key="out" class="plain" onClick=${signOut} aria-label=${`Sign out ${session.value.name}`}>Sign out</button>`}
    </div>
  </header>`;
}

const signOutError = signal("");

/** The page shows that nobody is signed in only once the service has ended the session. */
async function signOut() {
  signOutError.value = "";
  try {
    await command("/session", undefined, "DELETE");
    session.value = null;
    signedOut.value = true;
  } catch (error) {
    signOutError.value = `Still signed in: ${/** @type {Error} */ (error).message}`;
  }
}

export function Banner() {
  if (isSilent.value) {
    return html`<div class="banner" role="alert" key="silent">${AlarmSymbol(2)}
      <span><b>Service offline for ${silent_s.value} s.</b> What is shown is old. If the service has ended, it has ended its tests too, or the controllers do so by themselves, and the loops are as before; if only this screen has lost it, tests go on.</span></div>`;
  }
  if (newerVersion.value) {
    return html`<div class="banner calm" role="status" key="newer"><span>Loopwright was updated.</span><button onClick=${() => location.reload()}>Reload</button></div>`;
  }
  return null;
}

/** The loop whose test stands alone in the dock: that of the page. */
export const dockLoop = signal("");

const MOST = 6;

export function Dock() {
  const all = jobs.value.filter((each) => !each.dry_run);
  document.body.classList.toggle("docked", all.length > 0);
  if (!all.length) return null;
  const own = all.find((each) => each.loop === dockLoop.value);
  const shown = own ? [own] : all.slice(0, MOST);
  const more = all.length - shown.length;
  return html`<section class=${`dock ${shown.length > 1 ? "many" : ""}`} aria-label="Jobs under way">
    ${shown.map((job) => html`<${Cell} key=${job.id} job=${job} more=${own ? more : 0} />`)}
    ${!own && more > 0 && html`<a key="more" href="/ui/">${more} more under test</a>`}
  </section>`;
}

/** @param {{job: any, more: number}} props  more: tests that have no cell; nothing stands beside the button at the right. */
function Cell({ job, more }) {
  const stop = stopWords(job);
  const stopping = stop !== "";
  const error = stopping ? undefined : abortError.value.get(job.id); // an answer that was late or lost: the stream says it
  const left = isSilent.value ? "" : stopping ? "" : job.remaining_plant_time_s === null ? "" : `${duration(job.remaining_plant_time_s)} left`;
  const stage = stopping ? stop : job.state === "queued" ? "queued" : stageName(job.stage) || "begins";
  return html`<div class="cell">
    <a class="tag" href=${loopPath(job.loop)}>${job.loop}</a>
    <span class="stage" aria-live="polite">${stage}</span>
    ${Progress(job.progress, stopping)}
    <span>${left}</span>
    ${more > 0 && html`<a key="more" href="/ui/">${more} more under test</a>`}
    ${error && html`<b role="alert">${error}</b>`}
    ${may.operate.value && html`<button class="abort" disabled=${stopping} onClick=${() => abortJob(job)}>${stopping ? "Aborting…" : html`Abort ${job.loop}`}</button>`}
  </div>`;
}

/** @param {number | null} fraction @param {boolean} [stopping] */
export function Progress(fraction, stopping = false) {
  const done = Math.min(1, Math.max(0, fraction ?? 0));
  return html`<span class=${`progress ${stopping ? "stopping" : ""}`} role="progressbar" aria-label="Progress of the job" aria-valuemin="0" aria-valuemax="100" aria-valuenow=${Math.round(done * 100)}><span style=${{ transform: `scaleX(${done.toFixed(4)})` }}></span></span>`;
}
