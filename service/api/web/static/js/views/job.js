// @ts-check
/** One job on a page of its own. */
import { useEffect, useState } from "../../vendor/hooks.js";
import { ask } from "../api.js";
import { html } from "../html.js";
import { duration, when } from "../numbers.js";
import { loopPath } from "../router.js";
import { jobs, loops, rowOf } from "../state.js";
import { headline, methodName, sentence } from "../words.js";
import { dockLoop } from "./frame.js";
import { Result } from "./result.js";
import { UnderTest } from "./undertest.js";

/** @param {{id: string}} props */
export function JobView({ id }) {
  const [job, setJob] = useState(/** @type {any} */ (null));
  const [detail, setDetail] = useState(/** @type {any} */ (null));
  const [problem, setProblem] = useState("");
  const live = jobs.value.find((each) => each.id === id) ?? null;
  const row = job ? rowOf(job.loop).value : null;
  useEffect(() => {
    document.title = `Job ${id} · Loopwright`;
    const stop = new AbortController();
    ask(`/jobs/${encodeURIComponent(id)}`, stop.signal).then(
      (found) => {
        setJob(found);
        dockLoop.value = found.loop;
        if (loops.peek()?.has(found.loop)) void ask(`/loops/${encodeURIComponent(found.loop)}`, stop.signal).then(setDetail, () => {});
      },
      (error) => {
        if (!stop.signal.aborted) setProblem(error.message);
      },
    );
    return () => {
      stop.abort();
      dockLoop.value = "";
    };
  }, [id, live?.stage, live === null, row?.last_job?.state, loops.value === null]);
  const loop = job && (loops.value?.get(job.loop) ?? detail);
  const removed = job && loops.value && !loop;
  if (!job || !(loop || removed)) return html`<p class="calm" role="status">${problem || "Asking for the job…"}</p>`;
  if (removed) return html`<${OfRemoved} job=${job} />`;
  return html`<div><div class="looptitle" key="title"><h1 class="tag"><a href=${loopPath(job.loop)}>${job.loop}</a></h1><span class="what">${loop.description}</span><span class="where">job ${job.id}${job.dry_run ? " · rehearsal" : ""}</span></div>
    ${live ? html`<${UnderTest} key="test" loop=${loop} live=${live} job=${job} />` : html`<${Result} key="result" loop=${loop} detail=${detail} job=${job} own=${true} onChanged=${setJob} />`}</div>`;
}

/** A job whose loop is not configured any more: what it found needs no loop. @param {{job: any}} props */
function OfRemoved({ job }) {
  return html`<div><div class="looptitle" key="title"><h1 class="tag">${job.loop}</h1><span class="where">job ${job.id}${job.dry_run ? " · rehearsal" : ""}</span></div>
    <p class="refusal" key="removed">The loop ${job.loop} is not configured any more: its job can be read, and nothing be decided about it here.</p>
    <section key="result" aria-label="Result"><div class="headline"><div><h2>${headline(job)}</h2></div>
      <p class="facts">${when(job.ended_at ?? job.created_at)} · ${job.by} · ${methodName(job.method)} · ${duration(job.plant_time_s)} of plant time<br />
        <a href=${`${job.url}/report`} target="_blank">Report</a><a href=${`${job.url}/samples?format=csv`} target="_blank">Samples</a></p></div>
      ${job.reason && html`<div class="card" key="why"><p>${sentence(job.detail)}</p><p class="advice">${job.advice}</p></div>`}</section></div>`;
}
