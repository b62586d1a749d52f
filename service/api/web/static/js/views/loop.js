// @ts-check
/** One loop: its face, trend, gains, limits, what is known of its plant, its tests; the test under way; the latest result. */
import { useEffect, useRef, useState } from "../../vendor/hooks.js";
import { activeAlarms } from "../alarms.js";
import { ask, askPage, command } from "../api.js";
import { GatewayName, isElsewhere, refreshGateways } from "../gateways.js";
import { html } from "../html.js";
import { known, ms, period, pvDecimals, fixed, significant, unit, when } from "../numbers.js";
import { jobPath } from "../router.js";
import { isSilent, jobs, loops, loopsError, may, refreshLoops, rowOf, sign, signature } from "../state.js";
import { AlarmSymbol } from "../symbols.js";
import { sentence, stateWords, weight } from "../words.js";
import { Face } from "./face.js";
import { dockLoop } from "./frame.js";
import { Known } from "./known.js";
import { Result } from "./result.js";
import { RetuneForm } from "./retune.js";
import { asking, AcknowledgeButton, AcknowledgeQuestion } from "./acknowledge.js";
import { Trend } from "./trend.js";
import { UnderTest } from "./undertest.js";

const REREAD_MS = 60_000;
/** Chosen once: a test with its stages is seen whole, and a trend that was made anew would be empty for a while. */
const TREND_PX = Math.max(240, Math.min(400, innerHeight - 620));

/** @param {{tag: string}} props */
export function LoopView({ tag }) {
  const loop = loops.value?.get(tag);
  const [detail, setDetail] = useState(/** @type {any} */ (null));
  const [tests, setTests] = useState(/** @type {any[]} */ ([]));
  const [result, setResult] = useState(/** @type {any} */ (undefined)); // null: there is none; undefined: not known yet
  const [running, setRunning] = useState(/** @type {any} */ (null));
  const [open, setOpen] = useState(/** @type {boolean | null} */ (null));
  const job = jobs.value.find((each) => each.loop === tag && !each.dry_run) ?? null;
  const row = rowOf(tag).value;
  const mark = `${row?.job ?? ""} ${row?.last_job?.url ?? ""} ${row?.last_job?.state ?? ""} ${loop?.locked?.since ?? ""} ${row?.no_data ? "no data" : ""}`;

  useEffect(() => {
    document.title = `${tag} · Loopwright`;
    dockLoop.value = tag;
    return () => {
      dockLoop.value = "";
    };
  }, [tag]);

  useEffect(() => {
    const stop = new AbortController();
    const path = `/loops/${encodeURIComponent(tag)}`;
    const read = () => ask(path, stop.signal).then(setDetail, () => {});
    void read();
    void askPage(`${path}/jobs?limit=8`, stop.signal).then(async ({ entries }) => {
      setTests(entries);
      const latest = entries.find((/** @type {any} */ each) => !each.dry_run && !["queued", "running"].includes(each.state));
      setResult(latest ? await ask(latest.url, stop.signal) : null);
    }).catch(() => {
      if (!stop.signal.aborted) setResult((/** @type {any} */ known) => known ?? null);
    });
    const timer = setInterval(() => {
      if (!document.hidden && !isSilent.peek()) void read();
    }, REREAD_MS);
    return () => {
      stop.abort();
      clearInterval(timer);
    };
  }, [tag, mark]);

  const elsewhere = loop ? isElsewhere(loop) : false;
  useEffect(() => {
    if (elsewhere) void refreshGateways();
  }, [elsewhere, tag]);

  useEffect(() => {
    if (!job) {
      setRunning(null);
      return;
    }
    const stop = new AbortController();
    void ask(job.url, stop.signal).then(setRunning, () => {});
    return () => stop.abort();
  }, [job?.id, job?.stage, job?.stopping]);

  if (!loop) {
    return html`<p class="calm" role="status">${loops.value ? `There is no loop ${tag} here.` : loopsError.value ? loopsError.value.message : "Asking for the loop…"}</p>`;
  }
  const onJob = (/** @type {any} */ event) => {
    if (["stage_started", "stage_done", "note", "resumed", "state"].includes(event.kind)) void ask(`/jobs/${event.job}`).then((found) => {
      if (["queued", "running"].includes(found.state)) setRunning(found);
      else if (rowOf(tag).peek()?.last_job?.url === found.url) setResult(found);
    }, () => {});
  };
  const formOpen = !job && (open ?? (result === null && may.operate.value));
  const mine = (activeAlarms.value ?? []).filter((each) => each.loops.includes(tag));
  // A test that has just ended is not shown with the result of the one before it.
  const isLatest = !row?.last_job || row.last_job.url === result?.url;
  const height = TREND_PX;
  return html`<div>
    <div class="looptitle" key="title"><h1 class="tag">${tag}</h1><span class="what">${loop.description}</span>
      <span class="where">${[loop.area, loop.bus, `node ${loop.controller_node.toString(16)}h`, `channel ${loop.channel}`].filter(Boolean).join(" · ")}${elsewhere && html` · by way of ${GatewayName(loop)}`}</span>
      ${!job && !formOpen && result !== undefined && may.operate.value && html`<button key="retune" id="retune" onClick=${() => setOpen(true)}>Retune…</button>`}
      ${!may.operate.value && html`<span key="may" class="quiet">Your key may read. To retune it needs the scope operate.</span>`}
    </div>
    ${mine.map((each) => html`<div class="loop-alarm" key=${each.id}>${AlarmSymbol(each.priority)}<span><b>${each.text}.</b> <span class="quiet">${each.advice}</span></span>${AcknowledgeButton(each)}
      ${asking.value === each.id && html`<${AcknowledgeQuestion} key="question" alarm=${each} />`}</div>`)}
    ${elsewhere && row?.no_data && !isSilent.value && !mine.some((each) => each.kind === "gateway_offline") && html`<p class="refusal" key="gateway" role="status"><b>${row.no_data}.</b></p>`}
    ${detail?.restore_unconfirmed && html`<p class="refusal" key="home">${sentence(detail.restore_unconfirmed.advice)}</p>`}
    ${loop.locked && html`<p class="refusal" key="lock">Locked by ${loop.locked.by} since ${when(loop.locked.since)}: ${loop.locked.reason}. Tests and decisions wait until it is unlocked. ${may.operate.value && html`<${Unlock} key="unlock" tag=${tag} />`}</p>`}
    <div class="loop" key="loop">
      <aside key="aside"><${Face} key="face" loop=${loop} />${Settings(loop, detail)}<${Known} key="known" loop=${loop} detail=${detail} />${Tests(tests)}</aside>
      <div key="right">
        <${Trend} key="trend" loop=${loop} job=${job} height=${height} onJob=${onJob} />
        ${formOpen && html`<${RetuneForm} key="form" loop=${loop} onClose=${result ? () => { setOpen(false); focusOpener(); } : null} onStarted=${() => { setOpen(false); focusTest(); }} />`}
        ${job && html`<${UnderTest} key="test" loop=${loop} live=${job} job=${running?.id === job.id ? running : null} />`}
        ${!job && result && !isLatest && html`<p key="asking" class="quiet" role="status">Asking for the result…</p>`}
        ${!job && result && isLatest && html`<${Result} key=${`result ${result.id}`} loop=${loop} detail=${detail} job=${result} quiet=${formOpen} onChanged=${setResult} />`}
      </div>
    </div>
  </div>`;
}

/** The focus goes back to what opened the form, once it is drawn again. */
function focusOpener() {
  requestAnimationFrame(() => requestAnimationFrame(() => document.getElementById("retune")?.focus()));
}

/** The question that unlocks a loop, signed. @param {{tag: string}} props */
function Unlock({ tag }) {
  const [asking, setAsking] = useState(false);
  const [problem, setProblem] = useState("");
  const field = useRef(/** @type {HTMLInputElement | null} */ (null));
  useEffect(() => field.current?.focus(), [asking]);
  const dead = isSilent.value || !signature.value.trim();
  const send = async () => {
    try {
      await command(`/loops/${encodeURIComponent(tag)}/unlock`, { by: signature.value.trim() });
      setAsking(false);
      void refreshLoops();
    } catch (error) {
      setProblem(/** @type {Error} */ (error).message);
    }
  };
  const keys = (/** @type {KeyboardEvent} */ e) => {
    if (e.key === "Enter" && !dead) void send();
    if (e.key === "Escape") setAsking(false);
  };
  if (!asking) return html`<button class="plain" onClick=${() => setAsking(true)}>Unlock…</button>`;
  return html`<span class="ask" role="group" aria-label=${`Unlock ${tag}`}><label>Your name <input ref=${field} type="text" maxlength="100" autocomplete="name" value=${signature.value} onInput=${(/** @type {any} */ e) => sign(e.target.value)} onKeyDown=${keys} /></label>
    <button onClick=${() => setAsking(false)}>Cancel</button><button class="main" disabled=${dead} onClick=${send}>Unlock ${tag}</button>${problem && html` <span role="alert">${problem}</span>`}</span>`;
}

/** The focus goes from the form, which is gone, to the test that it has started, once it is drawn. */
function focusTest() {
  const from = document.activeElement;
  let tries = 50;
  const timer = setInterval(() => {
    const test = document.getElementById("under-test");
    const moved = document.activeElement !== from && document.activeElement !== document.body; // by a person, meanwhile
    if (test && !moved) test.focus({ preventScroll: true });
    if (test || moved || !--tries) clearInterval(timer);
  }, 100);
}

/** @param {any} loop @param {any} detail */
function Settings(loop, detail) {
  const live = detail?.live;
  const gains = live?.gains;
  const decimals = Math.min(3, pvDecimals(loop.pv_limits));
  const u = unit(loop.pv_unit);
  return html`<section class="card" key="settings" aria-label="Gains and limits">
    <h2 class="title" key="t1">Gains in effect</h2>
    ${gains ? html`<dl class="pairs" key="gains"><dt>Kp</dt><dd>${significant(gains.Kp)} <span class="quiet">%/${u}</span></dd><dt>Ti</dt><dd>${gains.Ti ? significant(gains.Ti) : "off"} <span class="quiet">s</span></dd>
      ${gains.Td > 0 && html`<dt key="td">Td</dt><dd key="tdv">${significant(gains.Td)} <span class="quiet">s</span></dd>`}
      ${weight(gains) && html`<dt key="b">b</dt><dd key="bv">${significant(gains.b, 3)}</dd>`}
      <dt>action</dt><dd>${live.reverse_acting ? "reverse" : "direct"}</dd><dt>sampled</dt><dd>every ${period(live.sample_time_s)}</dd></dl>`
    : html`<p key="none" class="quiet">${detail?.live_error ? `${sentence(detail.live_error.detail)} ${detail.live_error.advice}` : detail ? "not known here" : "reading…"}</p>`}
    ${loop.gains_differ && loop.accepted && html`<p class="note" key="differ">Accepted last: Kp ${significant(loop.accepted.gains.Kp)}, Ti ${significant(loop.accepted.gains.Ti)} s${weight(loop.accepted.gains)}, by ${loop.accepted.by}, ${when(loop.accepted.at)}.</p>`}
    <h2 class="title" key="t2">Limits</h2>
    <dl class="pairs" key="limits"><dt>PV</dt><dd>${fixed(loop.pv_limits.low, decimals)} … ${fixed(loop.pv_limits.high, decimals)} <span class="quiet">${u}</span></dd>
      <dt>MV</dt><dd>${significant(loop.mv_limits.low, 3)} … ${significant(loop.mv_limits.high, 3)} <span class="quiet">%</span></dd>
      <dt>SP step</dt><dd>${{ both: "±", up: "+", down: "−" }[/** @type {"both" | "up" | "down"} */ (loop.test.directions)]} ${fixed(loop.sp_deviation, decimals)} <span class="quiet">${u}</span></dd><dt>excitation</dt><dd>${loop.test.excitations.map((/** @type {string} */ each) => ({ setpoint: "set-point", manual: "manual output" }[each] ?? each)).join(", ")}</dd></dl>
    ${loop.notes && html`<p class="note" key="notes">${loop.notes}</p>`}
  </section>`;
}

/** @param {any[]} tests */
function Tests(tests) {
  return html`<section class="card tests" key="tests"><h2 class="title">Earlier jobs</h2>
    ${tests.length ? html`<ul class="tests">${tests.slice(0, 6).map((each) => html`<li key=${each.id}><a href=${jobPath(each.url)}>${when(each.ended_at ?? each.created_at)}</a>
      <small>${each.dry_run ? "rehearsal · " : ""}${stateWords(each)}${known(each.request.Ms) ? ` · Ms ${ms(each.request.Ms)}` : ""}</small></li>`)}</ul>` : html`<p class="quiet">none yet</p>`}</section>`;
}
