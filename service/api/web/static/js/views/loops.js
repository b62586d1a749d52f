// @ts-check
/** All loops: PV between its limits, what is under test, what awaits a decision, what is in alarm. */
import { computed, signal } from "../../vendor/signals-core.js";
import { useEffect } from "../../vendor/hooks.js";
import { worstOf } from "../alarms.js";
import { ask } from "../api.js";
import { isElsewhere } from "../gateways.js";
import { html } from "../html.js";
import { ago, duration, fixed, known, ms, pvDecimals, unit } from "../numbers.js";
import { go, loopPath } from "../router.js";
import { buses, isSilent, jobs, loops, loopsError, now_s, rowOf } from "../state.js";
import { AlarmSymbol, DecisionSign, TestSign } from "../symbols.js";
import { ageWords, valuesOf } from "../values.js";
import { modeWord, reasonWords, stageName, sentence } from "../words.js";
import { Progress } from "./frame.js";

const find = signal("");
const area = signal("");
const onlyLook = signal(false);
/** The line under the keyboard's mark. */
const atRow = signal("");

/** The last five minutes, by tag. */
const sparks = signal(/** @type {Map<string, any>} */ (new Map()));
const SPARK_S = 300;

const jobByLoop = computed(() => new Map(jobs.value.filter((each) => !each.dry_run).map((each) => [each.loop, each])));

/** @param {any} loop */
const waits = (loop) => loop.last_job?.state === "proposed" && !jobByLoop.value.has(loop.tag);
/** @param {any} loop */
const needsLook = (loop) => jobByLoop.value.has(loop.tag) || waits(loop) || worstOf.value.has(loop.tag);

const listed = computed(() => {
  const text = find.value.trim().toLowerCase();
  return [...(loops.value?.values() ?? [])]
    .filter((loop) => !area.value || (loop.area ?? "") === area.value)
    .filter((loop) => !onlyLook.value || needsLook(loop))
    .filter((loop) => !text || `${loop.tag} ${loop.description} ${loop.area ?? ""}`.toLowerCase().includes(text))
    .sort((a, b) => (a.area ?? "\uffff").localeCompare(b.area ?? "\uffff") || a.tag.localeCompare(b.tag, undefined, { numeric: true }));
});

export function LoopsView() {
  useEffect(() => {
    document.title = "Loops · Loopwright";
    let stopped = false;
    let asking = false; // of many loops the answer may take longer than the interval
    const look = async () => {
      if (document.hidden || isSilent.peek() || asking) return;
      asking = true;
      try {
        const found = await ask(`/history?seconds=${SPARK_S}&points=75`);
        if (!stopped) sparks.value = new Map(found.loops.map((/** @type {any} */ each) => [each.tag, { ...each, from_s: found.from_s, to_s: found.to_s }]));
      } catch {
        // The next look says more.
      } finally {
        asking = false;
      }
    };
    void look();
    const timer = setInterval(look, 3000);
    addEventListener("keydown", keys);
    return () => {
      stopped = true;
      clearInterval(timer);
      removeEventListener("keydown", keys);
    };
  }, []);
  if (!loops.value) return html`<p class="calm" role="status">${loopsError.value ? loopsError.value.message : "Asking for the loops…"}</p>`;
  if (!loops.value.size) return html`<p class="calm">No loops are configured. They are named in loops.yaml, with which the service is started.</p>`;
  const areas = [...new Set([...loops.value.values()].map((loop) => loop.area).filter(Boolean))].sort();
  const shown = listed.value;
  /** @type {Map<string, any[]>} */
  const groups = new Map();
  for (const loop of shown) groups.set(loop.area ?? "", [...(groups.get(loop.area ?? "") ?? []), loop]);
  return html`<div class="loopsview">
    <div class="pagehead" key="head">
      <h1>Loops</h1>
      <input id="find" type="search" placeholder="Find  /" aria-label="Find a loop" value=${find.value} onInput=${(/** @type {any} */ e) => (find.value = e.target.value)}
        onKeyDown=${(/** @type {any} */ e) => { if (e.key === "Enter" && listed.value.length === 1) go(loopPath(listed.value[0].tag)); }} />
      ${areas.length > 1 && html`<span class="segments" role="group" aria-label="Area">
        ${["", ...areas].map((name) => html`<button key=${name} aria-pressed=${String(area.value === name)} onClick=${() => (area.value = name)}>${name || "All areas"}</button>`)}</span>`}
      <label class="check"><input type="checkbox" checked=${onlyLook.value} onChange=${(/** @type {any} */ e) => (onlyLook.value = e.target.checked)} /> needs attention</label>
      <${Sentence} />
    </div>
    ${shown.length ? html`<div class="table loops" key="table"><table>
      <thead><tr><th class="sign"><span class="hidden-words">State</span></th><th>Loop</th><th class="num">PV</th><th class="unit"><span class="hidden-words">Unit of PV</span></th><th class="c-limits">between its limits</th><th class="num c-sp">SP</th><th class="c-spark">last 5 min</th><th class="num c-mv">MV</th><th class="c-mv"><span class="hidden-words">MV between its limits</span></th><th class="c-mode">Mode</th><th>Tuning</th></tr></thead>
      ${[...groups].map(([name, members]) => html`<tbody key=${name}>
        ${groups.size > 1 || name ? html`<tr class="area" key="area"><th colspan="11" scope="rowgroup">${name || "No area"}</th></tr>` : null}
        ${members.map((loop) => html`<${Row} key=${loop.tag} loop=${loop} />`)}</tbody>`)}
    </table></div>` : html`<p class="calm" key="none">${onlyLook.value && !find.value ? "No loop needs attention." : "No loop is found by this."}</p>`}
    ${buses.value.filter((each) => each.up === false).map((each) => html`<p class="busline" key=${`${each.gateway} ${each.bus}`}>${AlarmSymbol(2)}<span>Bus <b>${each.bus}</b>${isElsewhere(each) ? ` of gateway ${each.gateway}` : ""} is down, opening it again every 2 s. <span class="quiet">${sentence(each.why ?? "")}</span></span></p>`)}
  </div>`;
}

function Sentence() {
  const all = [...(loops.value?.values() ?? [])];
  const parts = [
    [all.length, all.length === 1 ? "loop" : "loops"],
    [jobByLoop.value.size, "under test"],
    [all.filter(waits).length, "awaiting decision"],
    [worstOf.value.size, "in alarm"],
  ].filter(([count], n) => n === 0 || count);
  return html`<span class="sentence">${parts.map(([count, words], n) => html`${n ? " · " : ""}<b>${count}</b> ${words}`)}</span>`;
}

/** @param {{loop: any}} props */
function Row({ loop }) {
  const values = valuesOf(rowOf(loop.tag).value, isSilent.value);
  const { pv, sp, mv, mode, old } = values;
  const decimals = pvDecimals(loop.pv_limits);
  const alarm = worstOf.value.get(loop.tag);
  const job = jobByLoop.value.get(loop.tag);
  const outside = pv !== null && !old && (pv < loop.pv_limits.low || pv > loop.pv_limits.high);
  return html`<tr class=${`row ${atRow.value === loop.tag ? "at" : ""} ${old ? "old" : ""}`} data-tag=${loop.tag} onClick=${(/** @type {MouseEvent} */ e) => { if (!(/** @type {Element} */ (e.target).closest("a"))) go(loopPath(loop.tag)); }}>
    <td class="sign">${alarm ? AlarmSymbol(alarm.priority) : job ? TestSign() : waits(loop) ? DecisionSign() : null}</td>
    <td class="name"><a class="tag" href=${loopPath(loop.tag)}>${loop.tag}</a><small>${alarm ? html`<b>${alarm.text.split(": ")[0]}</b>` : loop.description}</small></td>
    <td class="num"><span class=${`pvnum ${outside ? "outside" : ""}`}>${fixed(pv, decimals)}</span><span class="name-below">${unit(loop.pv_unit)}</span>${old && html`<small key="age" class="age">${ageWords(values)}</small>`}</td>
    <td class="unit">${unit(loop.pv_unit)}</td>
    <td class="c-limits">${PvBar(loop, old ? null : pv, sp)}</td>
    <td class="num c-sp">${fixed(sp, decimals)}</td>
    <td class="c-spark"><${Spark} loop=${loop} dead=${pv === null || old} /></td>
    <td class="num c-mv">${fixed(mv, 1)} <span class="quiet">%</span></td>
    <td class="c-mv">${MvBar(loop, old ? null : mv)}</td>
    <td class="c-mode"><span class=${`mode ${mode === "experiment" ? "boxed test" : mode === "manual" || mode === "off" ? "boxed" : ""}`}>${modeWord(mode)}</span></td>
    <td>${Tuning(loop, job)}</td>
  </tr>`;
}

/** @param {any} loop @param {any} job */
function Tuning(loop, job) {
  if (job) {
    return html`<span class="tuning"><b>${job.stopping ? "stopping" : job.state === "queued" ? "queued" : stageName(job.stage) || "begins"}</b>${Progress(job.progress, job.stopping)}
      <span>${isSilent.value || job.remaining_plant_time_s === null ? "" : duration(job.remaining_plant_time_s)}</span></span>`;
  }
  const last = loop.last_job;
  const at = html`<span class="quiet" title=${last?.at}>${ago(last?.at, Math.floor(now_s.value / 10) * 10)}</span>`;
  if (loop.locked) return html`<span class="tuning">locked by ${loop.locked.by}</span>`;
  if (!last) return html`<span class="tuning quiet">not tuned yet</span>`;
  if (loop.gains_differ) return html`<span class="tuning">gains differ from the accepted</span>`;
  if (last.state === "proposed") return html`<span class="tuning"><b>awaiting decision</b> ${at}</span>`;
  if (last.state === "accepted") return html`<span class="tuning">${known(loop.accepted?.Ms) ? `Ms ${ms(loop.accepted.Ms)}` : "accepted"} ${at}</span>`;
  if (last.state === "rolled_back") return html`<span class="tuning">previous gains in effect ${at}</span>`;
  if (last.state === "no_gain") return html`<span class="tuning">no improvement ${at}</span>`;
  const word = last.state === "aborted" ? "stopped" : last.state;
  return html`<span class="tuning">${word}${last.reason ? `: ${reasonWords(last.reason)}` : ""} ${at}</span>`;
}

/** @param {any} loop @param {number | null} pv @param {number | null} sp */
export function PvBar(loop, pv, sp) {
  const { low, high } = loop.pv_limits;
  const x = (/** @type {number} */ value) => Math.min(168, Math.max(2, 2 + (166 * (value - low)) / (high - low)));
  if (pv === null) return html`<svg class="limits" viewBox="0 0 170 14" aria-hidden="true">${Hatch(0, 3, 170, 8)}</svg>`;
  const outside = pv < low || pv > high;
  return html`<svg class="limits" viewBox="0 0 170 14" aria-hidden="true"><rect x="0" y="4" width="170" height="7" class="f-track" />
    ${sp !== null && html`<rect key="near" x=${x(sp - loop.sp_deviation)} y="4" width=${x(sp + loop.sp_deviation) - x(sp - loop.sp_deviation)} height="7" class="f-good" /><path key="sp" d=${`M${x(sp).toFixed(1)} 2v11`} class="s-ink" />`}
    <path key="pv" d=${`M${(x(pv) - 4.5).toFixed(1)} 0h9l-3.6 5v9h-1.8v-9z`} class=${outside ? "f-alarm" : "f-live"} /></svg>`;
}

/** @param {any} loop @param {number | null} mv */
function MvBar(loop, mv) {
  if (mv === null) return html`<svg class="mvbar" viewBox="0 0 58 14" aria-hidden="true">${Hatch(0, 3, 58, 8)}</svg>`;
  const { low, high } = loop.mv_limits;
  return html`<svg class="mvbar" viewBox="0 0 58 14" aria-hidden="true"><rect x="1" y="3.5" width="56" height="7" class="f-track" /><rect x="1" y="3.5" width=${Math.max(0, Math.min(56, mv * 0.56)).toFixed(1)} height="7" class="f-mv" />
    <path d=${`M${1 + low * 0.56} 0v14M${1 + high * 0.56} 0v14`} class="s-ink" /></svg>`;
}

/** Rising lines, 6 apart, over a rectangle. @param {number} x @param {number} y @param {number} w @param {number} h */
export function Hatch(x, y, w, h) {
  let d = "";
  for (let at = 6 - h; at < w; at += 6) {
    const [from, to] = [Math.max(0, at), Math.min(w, at + h)]; // of a line that leaves the foot at `at`
    d += `M${x + from} ${y + h - (from - at)}l${to - from} ${from - to}`;
  }
  return html`<path d=${d} class="s-line" />`;
}

/** @param {{loop: any, dead: boolean}} props */
function Spark({ loop, dead }) {
  const found = sparks.value.get(loop.tag);
  if (!found || dead || !found.at_s.length) return html`<svg class="spark" aria-hidden="true"></svg>`;
  const { from_s, to_s } = found;
  let low = Infinity;
  let high = -Infinity;
  for (let n = 0; n < found.at_s.length; n++) {
    for (const value of [found.pv_min[n], found.pv_max[n], found.sp[n]]) {
      if (value === null) continue;
      low = Math.min(low, value);
      high = Math.max(high, value);
    }
  }
  const least = loop.sp_deviation;
  if (high - low < least) [low, high] = [(low + high - least) / 2, (low + high + least) / 2];
  const x = (/** @type {number} */ at) => (150 * (at - from_s)) / (to_s - from_s);
  const y = (/** @type {number} */ value) => 28 - (26 * (value - low)) / (high - low);
  let pv = "";
  let sp = "";
  let pen = false;
  let spPen = false;
  for (let n = 0; n < found.at_s.length; n++) {
    const at = found.at_s[n];
    if (at === null || found.pv_min[n] === null) {
      pen = spPen = false;
      continue;
    }
    pv += `${pen ? "L" : "M"}${x(at).toFixed(1)} ${y(found.pv_min[n]).toFixed(1)}L${x(at).toFixed(1)} ${y(found.pv_max[n]).toFixed(1)}`;
    pen = true;
    if (found.sp[n] !== null) {
      sp += `${spPen ? `H${x(at).toFixed(1)}V` : `M${x(at).toFixed(1)} `}${y(found.sp[n]).toFixed(1)}`;
      spPen = true;
    }
  }
  return html`<svg class="spark" viewBox="0 0 150 30" aria-hidden="true"><path d=${sp} class="s-pale" /><path d=${pv} class="s-live" /></svg>`;
}

/** @param {KeyboardEvent} event */
function keys(event) {
  const typing = /** @type {Element} */ (event.target).closest?.("input, select, textarea");
  if (event.key === "Escape" && typing) return /** @type {HTMLElement} */ (event.target).blur();
  if (typing || event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.key === "/") {
    event.preventDefault();
    document.getElementById("find")?.focus();
  }
  const tags = listed.value.map((loop) => loop.tag);
  const at = tags.indexOf(atRow.value);
  if (event.key === "j" || event.key === "k") {
    atRow.value = tags[Math.max(0, Math.min(tags.length - 1, at + (event.key === "j" ? 1 : -1)))] ?? "";
    document.querySelector(`[data-tag="${CSS.escape(atRow.value)}"]`)?.scrollIntoView({ block: "nearest" });
  }
  if (event.key === "Enter" && atRow.value && event.target === document.body) go(loopPath(atRow.value));
}
