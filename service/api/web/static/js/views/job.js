// @ts-check
/** One job on a page of its own. */
import { useEffect, useState } from "../../vendor/hooks.js";
import { ask } from "../api.js";
import { html } from "../html.js";
import { loopPath } from "../router.js";
import { jobs, loops, rowOf } from "../state.js";
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
        void ask(`/loops/${encodeURIComponent(found.loop)}`, stop.signal).then(setDetail, () => {});
      },
      (error) => {
        if (!stop.signal.aborted) setProblem(error.message);
      },
    );
    return () => {
      stop.abort();
      dockLoop.value = "";
    };
  }, [id, live?.stage, live === null, row?.last_job?.state]);
  const loop = job && (loops.value?.get(job.loop) ?? detail);
  if (!job || !loop) return html`<p class="calm" role="status">${problem || "Asking for the job…"}</p>`;
  return html`<div><div class="looptitle" key="title"><h1 class="tag"><a href=${loopPath(job.loop)}>${job.loop}</a></h1><span class="what">${loop.description}</span><span class="where">job ${job.id}${job.dry_run ? " · rehearsal" : ""}</span></div>
    ${live ? html`<${UnderTest} key="test" loop=${loop} live=${live} job=${job} />` : html`<${Result} key="result" loop=${loop} detail=${detail} job=${job} own=${true} onChanged=${setJob} />`}</div>`;
}
