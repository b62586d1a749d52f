// @ts-check
/** The live trend of a loop: windows, a test's window, zoom by dragging, one cursor. */
import { signal } from "../../vendor/signals-core.js";
import { useEffect, useRef } from "../../vendor/hooks.js";
import { ask } from "../api.js";
import { GatewayName, isElsewhere } from "../gateways.js";
import { html } from "../html.js";
import { fixed, pvDecimals, timeOfDay, unit } from "../numbers.js";
import { colour, shown } from "../palette.js";
import { hatched, makePlot, mark, yRange } from "../plot.js";
import { Ring, SET_BACK_S } from "../ring.js";
import { isSilent, now_s, rowOf } from "../state.js";
import { stream } from "../stream.js";
import { stageName } from "../words.js";

const WINDOWS = /** @type {const} */ ([["30 s", 30], ["2 min", 120], ["10 min", 600], ["30 min", 1800]]);
const LONGEST_S = 1800;
/** Between what the service keeps and the first live sample, and over a break of the stream: longer is a gap. */
const GAP_S = 3;
/** Of a loop of another gateway a value comes once a second; what comes sooner is the same one again. */
const SAME_S = 0.3;
/** A sample that is older is not shown as the present. */
const LATE_S = 3;
/** Not more than ten drawings a second: a process is not smoother at sixty. */
const DRAW_MS = 100;

/**
 * @param {{loop: any, job: any, height: number, onJob: (event: any) => void}} props
 * job: the live job of the loop; null: there is none.
 */
export function Trend({ loop, job, height, onJob }) {
  const upper = useRef(/** @type {HTMLElement | null} */ (null));
  const lower = useRef(/** @type {HTMLElement | null} */ (null));
  const held = useRef(/** @type {any} */ (null));
  if (!held.current) {
    held.current = {
      ring: new Ring(), window_s: 120, test: false, zoom: null, stages: [], job: null, dirty: true, pace: 1, begun_s: NaN, whole_plant_s: 0,
      chosen: signal("2 min"), zoomed: signal(false), at: signal(/** @type {any} */ (null)),
    };
  }
  const it = held.current;
  const testing = job && job.state === "running" && !job.dry_run;
  if (testing && it.job?.id !== job.id) {
    it.began_s = now_s.peek() - (job.plant_time_s ?? 0);
    it.begun_s = NaN;
    it.pace = 1;
    it.whole_plant_s = 0; // of the test; the pace is known a little later
    it.stages = [];
    it.test = true;
    it.zoom = null;
    it.chosen.value = "test";
    it.zoomed.value = false;
  }
  if (testing) {
    it.job = job;
    it.pace = paceOf(job.plant_time_s, now_s.peek() - it.begun_s);
  }
  else if (it.job && !it.ended_s) it.ended_s = now_s.peek();
  if (testing) it.ended_s = 0;

  useEffect(() => {
    const decimals = pvDecimals(loop.pv_limits);
    const key = `trend ${loop.tag}`;
    let plots = /** @type {any[]} */ ([]);
    const onCursor = (/** @type {any} */ u) => {
      const n = u.cursor.idx;
      const left = u.cursor.left;
      if (n === null || n === undefined || left === undefined || left < 0) {
        if (it.at.peek()) it.at.value = null;
        return;
      }
      const data = it.data;
      if (data) it.at.value = { at: data.at[n], pv: data.pv[n], sp: data.sp[n], mv: data.mv[n] };
    };
    const onSelect = (/** @type {number} */ from, /** @type {number} */ to) => {
      it.zoom = [from, to];
      it.zoomed.value = true;
      it.dirty = true;
    };
    const future = (/** @type {any} */ u, /** @type {CanvasRenderingContext2D} */ ctx) => {
      if (!it.test || it.zoom || it.ended_s) return;
      const x = u.valToPos(Math.max(it.ring.last, it.began_s), "x", true);
      ctx.fillStyle = colour("future");
      ctx.fillRect(x, u.bbox.top, u.bbox.left + u.bbox.width - x, u.bbox.height);
    };
    const marks = (/** @type {any} */ u, /** @type {any} */ ctx, /** @type {boolean} */ named) => {
      let last = -Infinity;
      let row = 0;
      for (const each of it.stages) {
        const x = u.valToPos(each.at_s, "x", true);
        row = x - last < 90 * devicePixelRatio ? row + 1 : 0;
        last = x;
        mark(u, ctx, each.at_s, named ? stageName(each.stage) : "", row);
      }
    };
    const zero = () => (it.zoom ? null : it.test ? it.began_s : it.present_s);
    const pace = () => (it.test && !it.zoom ? it.pace : 1);
    if (upper.current && lower.current) {
      plots = [
        makePlot(upper.current, {
          lines: [{ label: "SP", colour: "sp", dash: [6, 4], width: 1.2, stepped: true }, { label: "PV", colour: "pv" }],
          height: Math.round(height * 0.64), withTime: false, zero, pace, sync: key, onCursor, onSelect,
          beneath: (u, ctx) => {
            hatched(u, ctx, loop.pv_limits.high, u.scales.y.max);
            hatched(u, ctx, u.scales.y.min, loop.pv_limits.low);
          },
          above: (u, ctx) => { future(u, ctx); marks(u, ctx, true); },
        }),
        makePlot(lower.current, {
          lines: [{ label: "MV", colour: "mv", stepped: true }],
          height: Math.round(height * 0.36) + 24, withTime: true, zero, pace, sync: key, onCursor, onSelect,
          beneath: (u, ctx) => {
            hatched(u, ctx, loop.mv_limits.high, u.scales.y.max);
            hatched(u, ctx, u.scales.y.min, loop.mv_limits.low);
          },
          above: (u, ctx) => { future(u, ctx); marks(u, ctx, false); },
        }),
      ];
    }
    const draw = () => {
      it.dirty = false;
      const now = now_s.peek();
      const end = now - it.ring.last < LATE_S ? it.ring.last : now; // what is late is a gap at the right edge
      it.present_s = end;
      /** @type {[number, number]} */
      let x = [end - it.window_s, end];
      if (it.zoom) x = it.zoom;
      else if (it.test && it.began_s) {
        const passed = it.pace * (end - it.began_s);
        const whole = Math.max(passed + (it.job?.remaining_plant_time_s ?? 20), 10);
        it.whole_plant_s = Math.max(whole, it.whole_plant_s > passed ? it.whole_plant_s : 0);
        x = [it.began_s - 2, it.ended_s ? Math.max(it.ended_s, it.began_s + 5) + 5 : it.began_s + it.whole_plant_s / it.pace];
      }
      const data = it.ring.since(x[0]);
      it.data = data;
      plots[0]?.show([data.at, data.sp, data.pv], x, yRange([data.sp, data.pv], 1.2 * loop.sp_deviation));
      plots[1]?.show([data.at, data.mv], x, yRange([data.mv], 10));
    };
    const timer = setInterval(() => {
      const late = now_s.peek() - it.ring.last >= LATE_S;
      if ((it.dirty || late) && !document.hidden) requestAnimationFrame(draw);
    }, DRAW_MS);
    const unsubscribe = shown.subscribe(() => { it.dirty = true; });

    const stop = new AbortController();
    let joined = false; // the past as the service keeps it, and what the stream has brought, are one ring
    /** @type {any[]} */
    let waiting = [];
    /** @type {any} */
    let past = null;
    const join = (/** @type {boolean} */ whatever) => {
      if (joined || (!whatever && (past === null || !waiting.length))) return;
      joined = true;
      const begin = waiting[0]?.at_s[0] ?? Infinity;
      it.ring.clear();
      if (past) takeHistory(it.ring, past, begin);
      for (const each of waiting) {
        if (each.at_s.length && each.at_s[0] - it.ring.last > GAP_S) it.ring.gap();
        it.ring.take(each);
      }
      waiting = [];
      it.dirty = true;
    };
    const listener = {
      samples: (/** @type {any} */ found) => {
        if (found.tag !== loop.tag) return;
        if (!joined) {
          waiting.push(found);
          join(false);
          return;
        }
        // After a break of the stream, which may be one of the service: what did not come is not drawn.
        const late_s = found.at_s.length ? found.at_s[0] - it.ring.last : 0;
        if (found.past ? late_s > 0 : it.opened !== stream.opened && late_s > GAP_S) it.ring.gap();
        it.opened = stream.opened;
        it.ring.take(found);
        it.dirty = true;
      },
      job: (/** @type {any} */ event) => {
        if (event.loop !== loop.tag) return;
        if (event.kind === "stage_started" || event.kind === "resumed") {
          const at_s = Date.parse(event.at) / 1000;
          if (it.stagesOf !== event.job || event.kind === "resumed") it.stages = [];
          it.stagesOf = event.job;
          if (event.kind !== "resumed" && !it.stages.some((/** @type {any} */ each) => each.at_s === at_s)) it.stages = [...it.stages, { at_s, stage: event.data.stage }];
          if (it.stages.length === 1) it.began_s = it.begun_s = it.stages[0].at_s;
          it.dirty = true;
        }
        onJob(event);
      },
    };
    // The samples of another gateway do not come here: its values do, once a second.
    const leaveRow = rowOf(loop.tag).subscribe((row) => {
      if (!row || row.no_data !== null || row.age_s === null || !isElsewhere(loop)) return;
      const at_s = now_s.peek() - row.age_s;
      const since_s = at_s - it.ring.last;
      if (since_s < SAME_S && since_s > -SET_BACK_S) return;
      listener.samples({ tag: loop.tag, past: false, at_s: [at_s], pv: [row.pv], sp: [row.sp], mv: [row.mv], gap_before: since_s > GAP_S ? [0] : [] });
    });
    const leave = stream.watch(loop.tag, 130, listener);
    const late = setTimeout(() => join(true), 3000);
    void ask(`/loops/${encodeURIComponent(loop.tag)}/history?from=${now_s.peek() - LONGEST_S}&points=1500`, stop.signal).then(
      (found) => {
        past = found;
        join(false);
      },
      () => join(true),
    );
    const keys = (/** @type {KeyboardEvent} */ event) => {
      if (/** @type {Element} */ (event.target).closest?.("input, select, textarea") || event.ctrlKey || event.metaKey || event.altKey) return;
      const window = WINDOWS[Number(event.key) - 1];
      if (window) choose(it, window[0], window[1]);
      if (event.key === "t" && it.job) chooseTest(it);
    };
    addEventListener("keydown", keys);
    it.decimals = decimals;
    return () => {
      stop.abort();
      clearTimeout(late);
      leaveRow();
      leave();
      clearInterval(timer);
      unsubscribe();
      removeEventListener("keydown", keys);
      for (const each of plots) each.destroy();
    };
  }, [loop.tag, height]);

  const at = it.at.value;
  const decimals = pvDecimals(loop.pv_limits);
  return html`<section class=${`card trend ${isSilent.value ? "stale" : ""}`} aria-label=${`Trend of ${loop.tag}`}>
    <div class="top" key="top"><h2>Trend</h2>
      <span class="legend" aria-hidden="true"><span class="pv">PV</span><span class="sp">SP</span><span class="mv">MV</span></span>
      <span class="readout">${at && Number.isFinite(at.at) ? html`${timeOfDay(at.at)} · PV <b>${fixed(at.pv, decimals)}</b> · SP <b>${fixed(at.sp, decimals)}</b> · MV <b>${fixed(at.mv, 1)}</b>` : ""}</span>
      <span class="segments" role="group" aria-label="Window">
        ${it.zoomed.value && html`<button key="zoom" aria-pressed="true" onClick=${() => { it.zoom = null; it.zoomed.value = false; it.dirty = true; }}>zoomed ×</button>`}
        ${it.job && html`<button key="test" aria-pressed=${String(it.chosen.value === "test" && !it.zoomed.value)} onClick=${() => chooseTest(it)}>test</button>`}
        ${WINDOWS.map(([name, seconds]) => html`<button key=${name} aria-pressed=${String(it.chosen.value === name && !it.zoomed.value)} onClick=${() => choose(it, name, seconds)}>${name}</button>`)}
      </span></div>
    ${isElsewhere(loop) && html`<p class="note" key="elsewhere">Samples as they come are at ${GatewayName(loop)}; here is a value a second, and of the past what it has stored.</p>`}
    <span class="axis-name" key="n1">PV, ${unit(loop.pv_unit)}</span>
    <div class="plot" key="p1" ref=${upper} role="img" aria-label=${`PV and set-point of ${loop.tag}`}></div>
    <span class="axis-name" key="n2">MV, %${it.pace !== 1 && it.chosen.value === "test" && !it.zoomed.value ? "; the time is plant time since the test began" : ""}</span>
    <div class="plot" key="p2" ref=${lower} role="img" aria-label=${`MV of ${loop.tag}`}></div>
  </section>`;
}

/**
 * How many seconds of plant time a second is, of a test that has run for a while; 1 where both are about the same.
 * @param {number} plant_s @param {number} wall_s
 */
function paceOf(plant_s, wall_s) {
  const pace = wall_s > 0.5 && plant_s > 0 ? plant_s / wall_s : 1;
  return pace > 0.8 && pace < 1.25 ? 1 : pace;
}

/** Lowest and highest of each bin, evenly in time. @param {Ring} ring @param {any} past @param {number} begin_s */
function takeHistory(ring, past, begin_s) {
  const missing = new Set();
  for (const gap of past.gaps) {
    const n = past.at_s.findIndex((/** @type {number} */ at) => at >= gap.to_s - 1e-6);
    if (n >= 0) missing.add(n);
  }
  for (let n = 0; n < past.at_s.length && past.until_s[n] < begin_s; n++) {
    if (missing.has(n)) ring.gap();
    const middle = (past.at_s[n] + past.until_s[n]) / 2;
    if (past.samples[n] > 1) ring.push(past.at_s[n], past.pv_min[n], past.sp[n], past.mv_min[n]);
    ring.push(past.samples[n] > 1 ? middle : past.until_s[n], past.pv_max[n], past.sp[n], past.mv_max[n]);
  }
}

/** @param {any} it @param {string} name @param {number} seconds */
function choose(it, name, seconds) {
  it.window_s = seconds;
  it.test = false;
  it.zoom = null;
  it.chosen.value = name;
  it.zoomed.value = false;
  it.dirty = true;
}

/** @param {any} it */
function chooseTest(it) {
  it.test = true;
  it.zoom = null;
  it.chosen.value = "test";
  it.zoomed.value = false;
  it.dirty = true;
}
