// @ts-check
/** What is known of a loop's plant: from its tests, and from normal operation when asked. */
import { useEffect, useState } from "../../vendor/hooks.js";
import { ask } from "../api.js";
import { html } from "../html.js";
import { known, ms, msError, significant, withUnit, when } from "../numbers.js";

/** @param {{loop: any, detail: any}} props */
export function Known({ loop, detail }) {
  const [found, setFound] = useState(/** @type {any} */ (null));
  const [state, setState] = useState("");
  // What was found is of the gains that were in effect then.
  useEffect(() => setFound(null), [loop.last_job?.url, loop.last_job?.state, loop.gains_differ]);
  const look = async () => {
    setState("Identifying from the history…");
    try {
      setFound(await ask(`/loops/${encodeURIComponent(loop.tag)}/observation`));
      setState("");
    } catch (error) {
      const problem = /** @type {import("../api.js").Problem} */ (error);
      setState(`${problem.message} ${problem.advice ?? ""}`);
    }
  };
  const k = found?.knowledge ?? detail?.knowledge;
  return html`<section class="card" aria-label="Process model"><h2 class="title" key="t">Process model</h2>
    ${k ? html`<div key="k"><dl class="pairs"><dt>Ms now</dt><dd>${known(k.Ms) ? `${ms(k.Ms)}${known(k.uncertainty) ? ` ± ${msError(k.uncertainty)}` : ""}` : "–"}</dd>
      <dt>dead time</dt><dd>${withUnit(significant(k.model.dead_time_s, 3), "s")}</dd>
      ${known(k.changes) && html`<dt key="c">from</dt><dd key="cv">${k.changes} ${k.changes === 1 ? "change" : "changes"}</dd>`}
      ${k.consistent > 0 && html`<dt key="a">consistent with</dt><dd key="av">${k.consistent}</dd>`}</dl><p class="note">${k.text.replaceAll("+-", "± ")}</p></div>` : html`<p class="quiet" key="none">nothing yet</p>`}
    ${found && html`<div key="found"><p class="note">${found.known}<br />${found.detail}${found.advice ? html` <b>${found.advice}</b>` : ""}</p>
      <p class="quiet">${found.changes_used.length} set-point changes used, ${found.changes_dropped.length} left out, ${found.loads.length} loads found; last ${found.changes_used.length ? when(new Date(found.changes_used.at(-1).at_s * 1000).toISOString()) : "–"}.</p></div>`}
    <p class="foot" key="foot"><span class="left" role="status">${state}</span><button onClick=${look}>Identify from operation</button></p>
  </section>`;
}
