// @ts-check
/** Batches: the list, one batch with its loops, the form. */
import { useEffect, useRef, useState } from "../../vendor/hooks.js";
import { notAborted, sendAbort } from "../aborting.js";
import { ask, askPage, askWith, command } from "../api.js";
import { html } from "../html.js";
import { entered, ms, when } from "../numbers.js";
import { go, jobPath, loopPath } from "../router.js";
import { isSilent, jobs, may, sign, signature } from "../state.js";
import { reasonWords, stageName } from "../words.js";

const AGAIN_MS = 5000;
const [PAGE, MOST] = [50, 1000];

/** Whether loops of a batch are still to come, or under test. @param {{state: string}} retune */
const isGoing = ({ state }) => state === "running" || state === "stopping";

/** @param {{id: string}} props */
export function BatchesView({ id }) {
  return id ? html`<${One} key=${id} id=${id} />` : html`<${All} key="all" />`;
}

/** @param {Record<string, number>} counts */
const countWords = (counts) => Object.entries(counts).filter(([, n]) => n).map(([state, n]) => `${n} ${state.replaceAll("_", " ")}`).join(" · ");

function All() {
  const [rows, setRows] = useState(/** @type {any[] | null} */ (null));
  const [next, setNext] = useState(/** @type {string | null} */ (null));
  const [problem, setProblem] = useState("");
  const shown = useRef(PAGE); // those that were asked for with More stay
  const mark = jobs.value.map((each) => `${each.id}${each.state}`).join();
  const going = !rows || rows.some(isGoing);
  useEffect(() => {
    document.title = "Batches · Loopwright";
    const stop = new AbortController();
    const look = () => askPage(`/batches?limit=${shown.current}`, stop.signal).then((found) => {
      setRows(found.entries);
      setNext(found.next);
      setProblem("");
    }, (error) => { if (!stop.signal.aborted) setProblem(error.message); });
    void look();
    const timer = going ? setInterval(() => { if (!document.hidden && !isSilent.peek()) void look(); }, AGAIN_MS) : undefined;
    return () => {
      stop.abort();
      clearInterval(timer);
    };
  }, [mark, going]);
  const more = async () => {
    try {
      const found = await askPage(String(next));
      shown.current = Math.min(MOST, (rows ?? []).length + found.entries.length);
      setRows([...(rows ?? []), ...found.entries]);
      setNext(found.next);
    } catch (error) {
      setProblem(/** @type {Error} */ (error).message);
    }
  };
  return html`<div><div class="pagehead" key="head"><h1>Batches</h1></div>
    ${may.operate.value && html`<${Form} key="form" />`}
    ${problem && html`<p class="refusal" role="alert" key="problem">${problem}</p>`}
    ${rows && (rows.length ? html`<div class="table" key="table" style=${{ marginTop: "16px" }}><table><thead><tr><th>Date</th><th>Asked by</th><th>State</th><th>Loops</th></tr></thead><tbody>
      ${rows.map((each) => html`<tr class="row" key=${each.id} onClick=${() => go(`/ui${each.url}`)}><td><a href=${`/ui${each.url}`}>${when(each.created_at)}</a></td><td>${each.by}</td><td>${each.state}</td><td>${countWords(each.counts)}</td></tr>`)}</tbody></table></div>` : html`<p class="calm" key="none">No batch was asked for yet.</p>`)}
    ${next && html`<p class="foot" key="more"><button onClick=${more}>More</button></p>`}</div>`;
}

/** Whether a field holds something else than a whole number. @param {string} text */
const wrong = (text) => (Number.isInteger(entered(text) ?? 0) ? undefined : "true");

function Form() {
  const [pattern, setPattern] = useState("");
  const [asked, setAsked] = useState("1.6");
  const [perBus, setPerBus] = useState("");
  const [perArea, setPerArea] = useState("");
  const [failures, setFailures] = useState("3");
  const [preview, setPreview] = useState(/** @type {any} */ (null));
  const [problem, setProblem] = useState(/** @type {any} */ (null));
  const [sending, setSending] = useState(false);
  /** @type {Record<string, any>} */
  const body = { method: "fast", Ms: Number(asked), pattern: pattern.trim() || null };
  let bad = "";
  for (const [name, text] of [["at_once_per_bus", perBus], ["at_once_per_area", perArea], ["stop_after_failures", failures]]) {
    const value = entered(text);
    if (value === null) continue;
    if (Number.isInteger(value)) body[name] = value;
    else bad = "A field is not a whole number.";
  }
  const text = JSON.stringify(body);
  const isOfThis = !!preview && preview.of === text; // what is begun is what was said, and not what has been typed since
  useEffect(() => {
    if (!pattern.trim() || bad) {
      setPreview(null);
      return;
    }
    const stop = new AbortController();
    const timer = setTimeout(() => askWith("/batches/preview", JSON.parse(text), stop.signal).then((found) => { setPreview({ ...found, of: text }); setProblem(null); }, (error) => { if (!stop.signal.aborted) { setPreview(null); setProblem(error); } }), 300);
    return () => {
      clearTimeout(timer);
      stop.abort();
    };
  }, [text, bad]);
  const start = async () => {
    setSending(true);
    try {
      const found = await command("/batches", { ...body, by: signature.value.trim() });
      go(`/ui${found.url}`);
    } catch (error) {
      setProblem(error);
      setSending(false);
    }
  };
  const on = (/** @type {(v: string) => void} */ set) => (/** @type {any} */ e) => set(e.target.value);
  const dead = sending || isSilent.value || !!bad || !isOfThis || !preview?.would_start || !signature.value.trim();
  return html`<section class="card" aria-label="Retune many loops"><h2 class="title" key="t">Retune many</h2>
    <div class="options" key="fields" style=${{ borderTop: 0, marginTop: 0 }}>
      <label class="field"><span>Loops</span><input type="text" class="wide" placeholder="TIC-* or *" value=${pattern} onInput=${on(setPattern)} /></label>
      <label class="field"><span>Robustness asked for <b>Ms ${ms(Number(asked))}</b></span><input type="range" min="1.2" max="2" step="0.05" value=${asked} onInput=${on(setAsked)} /></label>
      <label class="field"><span>At once per bus</span><input type="text" inputmode="numeric" value=${perBus} aria-invalid=${wrong(perBus)} onInput=${on(setPerBus)} /></label>
      <label class="field"><span>At once per area</span><input type="text" inputmode="numeric" value=${perArea} aria-invalid=${wrong(perArea)} onInput=${on(setPerArea)} /></label>
      <label class="field"><span>Stop after failures</span><input type="text" inputmode="numeric" value=${failures} aria-invalid=${wrong(failures)} onInput=${on(setFailures)} /></label></div>
    ${preview && html`<div key="what" class="explain">${preview.summary.map((/** @type {string} */ line) => html`<p key=${line}>${line}</p>`)}</div>`}
    ${preview?.loops.filter((/** @type {any} */ each) => !each.would_start).map((/** @type {any} */ each) => html`<p class="note" key=${each.loop}><b>${each.loop}</b> ${each.obstacles[0]?.detail}. ${each.obstacles[0]?.advice}</p>`)}
    ${problem && html`<p class="refusal" role="alert" key="problem">${problem.message} <span class="advice">${problem.advice}</span></p>`}
    <div class="foot" key="foot"><label class="left">Your name <input type="text" maxlength="100" autocomplete="name" value=${signature.value} onInput=${(/** @type {any} */ e) => sign(e.target.value)} onKeyDown=${(/** @type {any} */ e) => { if (e.key === "Enter" && !dead) void start(); }} /></label>
      <span class="quiet" role="status">${bad}</span>
      <button class="main" disabled=${dead} onClick=${start}>${preview ? `Retune ${preview.would_start} ${preview.would_start === 1 ? "loop" : "loops"}` : "Retune"}</button></div></section>`;
}

/** @param {{id: string}} props */
function One({ id }) {
  const [found, setFound] = useState(/** @type {any} */ (null));
  const [asking, setAsking] = useState(false);
  const [problem, setProblem] = useState("");
  const [aborting, setAborting] = useState("");
  const mark = jobs.value.map((each) => `${each.id}${each.state}${each.stage}`).join();
  useEffect(() => {
    document.title = `Batch ${id} · Loopwright`;
    const stop = new AbortController();
    const look = () => ask(`/batches/${encodeURIComponent(id)}`, stop.signal).then((now) => { setFound(now); setProblem(""); }, (error) => { if (!stop.signal.aborted) setProblem(error.message); });
    void look();
    const timer = setInterval(look, AGAIN_MS);
    return () => {
      stop.abort();
      clearInterval(timer);
    };
  }, [id, mark]);
  if (!found) return html`<p class="calm" role="status">${problem || "Asking for the batch…"}</p>`;
  const going = isGoing(found);
  const abort = async () => {
    setAsking(false);
    setAborting("Abort sent, no answer yet.");
    try {
      setFound(await sendAbort(found));
      setAborting("");
    } catch (error) {
      setAborting(notAborted(/** @type {import("../api.js").Problem} */ (error)));
    }
  };
  return html`<div><div class="pagehead" key="head"><h1>Batch of ${found.loops.length} ${found.loops.length === 1 ? "loop" : "loops"}</h1><span class="quiet">${when(found.created_at)} · ${found.by} · ${found.state}</span><span class="sentence">${countWords(found.counts)}</span></div>
    ${found.detail && html`<p class="refusal" key="detail">${found.detail}</p>`}${problem && html`<p class="refusal" role="alert" key="problem">${problem}</p>`}${aborting && html`<p class="refusal" role="alert" key="aborting">${aborting}</p>`}
    ${going && may.operate.value && html`<p class="foot" key="abort">${asking ? html`<span key="q">This ends the batch of ${found.loops.length} loops.</span><button key="no" onClick=${() => setAsking(false)}>Go on</button><button key="yes" class="abort" onClick=${abort}>Abort all ${found.loops.length}</button>` : html`<button key="ask" class="abort" onClick=${() => setAsking(true)}>Abort all ${found.loops.length}…</button>`}</p>`}
    <div class="table" key="table"><table><thead><tr><th>Loop</th><th>State</th><th>Result</th><th>Job</th></tr></thead><tbody>
      ${found.loops.map((/** @type {any} */ each) => {
        const live = jobs.value.find((job) => job.url === each.job);
        return html`<tr key=${each.loop}><td><a class="tag" href=${loopPath(each.loop)}>${each.loop}</a></td><td>${each.state.replaceAll("_", " ")}${live ? `, ${stageName(live.stage)}` : ""}</td><td>${reasonWords(each.reason)} <span class="quiet">${each.detail}</span></td><td>${each.job && html`<a href=${jobPath(each.job)}>${each.job.split("/").at(-1)}</a>`}</td></tr>`;
      })}</tbody></table></div></div>`;
}
