// @ts-check
/** The jobs: what ran, who asked, what came of it, who decided. */
import { useEffect, useRef, useState } from "../../vendor/hooks.js";
import { askPage } from "../api.js";
import { html } from "../html.js";
import { known, ms, significant, when } from "../numbers.js";
import { go, jobPath, loopPath } from "../router.js";
import { jobs as live, loops } from "../state.js";
import { methodName, stageName, stateWords } from "../words.js";

const [PAGE, MOST] = [50, 200];
const STATES = ["", "proposed", "accepted", "rolled_back", "refused", "aborted", "failed", "interrupted", "no_gain", "rehearsed", "running", "queued"];

export function JobsView() {
  const [loop, setLoop] = useState(new URLSearchParams(location.search).get("loop") ?? "");
  const [state, setState] = useState("");
  const [rows, setRows] = useState(/** @type {any[] | null} */ (null));
  const [next, setNext] = useState(/** @type {string | null} */ (null));
  const [problem, setProblem] = useState("");
  // A decision of somebody else moves no live job, but the latest one of a loop.
  const decided = [...(loops.value?.values() ?? [])].map((each) => `${each.last_job?.url}${each.last_job?.state}`).join();
  const marks = `${live.value.map((each) => each.id + each.state).join()} ${decided}`;
  const path = `/jobs?${loop ? `&loop=${encodeURIComponent(loop)}` : ""}${state ? `&state=${state}` : ""}&limit=`.replace("?&", "?");
  const shown = useRef({ path, count: 0 }); // those that were asked for with More stay when something has changed
  useEffect(() => {
    document.title = "Jobs · Loopwright";
    const stop = new AbortController();
    const limit = shown.current.path === path ? Math.min(MOST, Math.max(PAGE, shown.current.count)) : PAGE;
    askPage(`${path}${limit}`, stop.signal).then(
      (found) => {
        shown.current = { path, count: found.entries.length };
        setRows(found.entries);
        setNext(found.next);
        setProblem("");
      },
      (error) => {
        if (!stop.signal.aborted) setProblem(error.message);
      },
    );
    return () => stop.abort();
  }, [path, marks]);
  const more = async () => {
    if (!next || !rows) return;
    try {
      const found = await askPage(next);
      if (shown.current.path !== path || shown.current.count !== rows.length) return; // the list is another one by now
      shown.current.count += found.entries.length;
      setRows([...rows, ...found.entries]);
      setNext(found.next);
    } catch (error) {
      setProblem(/** @type {Error} */ (error).message);
    }
  };
  return html`<div><div class="pagehead" key="head"><h1>Jobs</h1>
      <label class="check">Loop <select value=${loop} onChange=${(/** @type {any} */ e) => setLoop(e.target.value)}><option value="">all</option>${[...(loops.value?.keys() ?? [])].sort().map((tag) => html`<option key=${tag} value=${tag}>${tag}</option>`)}</select></label>
      <label class="check">Result <select value=${state} onChange=${(/** @type {any} */ e) => setState(e.target.value)}>${STATES.map((each) => html`<option key=${each} value=${each}>${each ? (each === "proposed" ? "awaiting decision" : each.replaceAll("_", " ")) : "all"}</option>`)}</select></label></div>
    ${problem && html`<p class="refusal" role="alert" key="problem">${problem}</p>`}
    ${!rows ? html`<p class="calm" role="status" key="wait">Asking for the jobs…</p>` : !rows.length ? html`<p class="calm" key="none">There are no such jobs.</p>` : html`<div class="table jobs" key="table"><table>
      <thead><tr><th>Date</th><th>Loop</th><th class="c-by">Asked by</th><th class="c-method">Procedure</th><th>Result</th><th>Kp</th><th>Ti, s</th><th>Ms</th><th class="c-decided">Decided</th></tr></thead>
      <tbody>${rows.map((job) => html`<tr class="row" key=${job.id} onClick=${(/** @type {MouseEvent} */ e) => { if (!(/** @type {Element} */ (e.target).closest("a"))) go(jobPath(job.url)); }}>
        <td><a href=${jobPath(job.url)}>${when(job.started_at ?? job.created_at)}</a></td><td><a class="tag" href=${loopPath(job.loop)}>${job.loop}</a></td><td class="c-by">${job.by}</td>
        <td class="c-method">${methodName(job.method)}${job.dry_run ? ", rehearsal" : ""}</td><td>${job.state === "proposed" && !job.superseded_by ? html`<b>${stateWords(job)}</b>` : stateWords(job)}${job.state === "running" ? `, ${stageName(job.stage)}` : ""}</td>
        ${Arrow(job.previous_gains?.Kp, job.new_gains?.Kp)}${Arrow(job.previous_gains?.Ti, job.new_gains?.Ti)}
        <td>${known(job.comparison?.new?.Ms) ? Change(ms(job.comparison.previous?.Ms), ms(job.comparison.new.Ms)) : Change("", known(job.predicted?.Ms) ? ms(job.predicted.Ms) : "")}</td>
        <td class="c-decided">${job.decided ? html`${job.decided.by} <span class="quiet">${when(job.decided.at)}</span>` : ""}</td></tr>`)}</tbody></table></div>`}
    ${next && html`<p class="foot" key="more"><button onClick=${more}>More</button></p>`}</div>`;
}

/** Old and new below those of the other rows. @param {string} before @param {string} after */
const Change = (before, after) => html`<span class="arrow"><span>${before}</span><span>${after ? "→" : ""}</span><span>${after}</span></span>`;

/** @param {number | undefined} before @param {number | undefined} after */
function Arrow(before, after) {
  return html`<td>${Change(known(before) ? significant(before) : "", known(after) ? significant(after) : "")}</td>`;
}
