// @ts-check
/** The test under way: its stages with what each found, the time left. */
import { html } from "../html.js";
import { duration } from "../numbers.js";
import { isSilent } from "../state.js";
import { sentence, stageFound, stageName, stagesOf, stageWhat } from "../words.js";
import { stopWords } from "../aborting.js";
import { Progress } from "./frame.js";

/** @param {{loop: any, live: any, job: any}} props  live: of the stream; job: as read, null: not yet. */
export function UnderTest({ loop, live, job }) {
  const stop = stopWords(live);
  const stopping = stop !== "";
  return html`<section class="card undertest" id="under-test" tabindex="-1" aria-label="Under test">
    <div class="split" key="top"><h2 class="title">${live.state === "queued" ? "Queued" : "Under test"}</h2>
      <span>${stopping ? stop : live.remaining_plant_time_s !== null && !isSilent.value ? html`about <b>${duration(live.remaining_plant_time_s)}</b> left <span class="quiet">of plant time, ${duration(live.plant_time_s)} so far</span>` : ""}</span></div>
    ${Progress(live.progress, stopping)}
    ${job ? Stages(job, loop.pv_unit, live.stage ?? "") : html`<p class="quiet" key="asking">Asking for the stages…</p>`}
    ${job?.attempts > 1 && html`<p class="note" key="resumed">Resumed after a restart of the service: the stages begin anew.</p>`}
    ${job?.notes.map((/** @type {string} */ note) => html`<p class="note" key=${note}>${sentence(note)}</p>`)}
    <p class="quiet who-asked" key="who">Asked for by ${live.by}.</p>
  </section>`;
}

/** The stages in a row. @param {any} job @param {string} pv @param {string | null} [now] */
export function Stages(job, pv, now = null) {
  const found = new Map(job.stages.map((/** @type {any} */ each) => [each.stage, each]));
  return html`<ol class="stages" key="stages" aria-live="polite">${stagesOf(job).map((name) => {
    const stage = found.get(name);
    const running = now !== null && name === now; // a stage that another has followed is done, whether it said so or not
    const done = stage && !running;
    return html`<li key=${name} class=${done ? "done" : running ? "now" : ""} aria-current=${running ? "step" : undefined}>
      <b>${done ? (stage.state === "ended" ? "✕ " : "✓ ") : ""}${stageName(name)}</b>
      ${running ? html`<small>${stageWhat(name)}</small>` : done ? stageFound(stage, pv).map((line) => html`<small key=${line}>${line}</small>`) : null}</li>`;
  })}</ol>`;
}
