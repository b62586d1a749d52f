// @ts-check
/** The watch of a loop since gains were accepted: what operation says of the model, change by change. */
import { useEffect } from "../../vendor/hooks.js";
import { ask } from "../api.js";
import { html } from "../html.js";
import { fixed, known, ms, significant, unit, when } from "../numbers.js";

const AGAIN_MS = 5000;
/** @type {Record<string, string>} */
const STATES = { confirmed: "confirms the model", differs: "shows another plant", disturbed: "disturbed", not_enough_excitation: "too small to tell" };
/** @type {Record<string, string>} */
const ENDS = {
  complete: "Monitoring is over.",
  gains_changed: "Monitoring has ended: somebody else has set other gains.",
  retuned: "Monitoring has ended with the next test.",
  rolled_back: "Monitoring has ended: the previous gains are back.",
  too_long: "Monitoring has ended after 30 days.",
};

/** @param {{loop: any, job: any, onChanged: (job: any) => void}} props */
export function Watch({ loop, job, onChanged }) {
  const w = job.monitoring;
  useEffect(() => {
    if (!w.active) return;
    const stop = new AbortController();
    const timer = setInterval(() => void ask(job.url, stop.signal).then(onChanged, () => {}), AGAIN_MS);
    return () => {
      clearInterval(timer);
      stop.abort();
    };
  }, [w.active, job.url]);
  const bad = w.action === "rollback";
  const u = unit(loop.pv_unit);
  return html`<section class="card" aria-label="Monitoring after acceptance"><h2 class="title" key="t">Monitoring after acceptance</h2>
    <p key="words" role="status" class=${bad ? "refusal" : ""}>${w.message.replaceAll("+-", "±")}</p>
    ${w.changes.length > 0 && html`<table class="figures" key="changes"><caption class="hidden-words">The changes that were compared with the model</caption>
      <thead><tr><th>Change</th><th class="num">set-point by, ${u}</th><th>it</th><th class="num">residual, × noise</th><th class="num">Ms then</th></tr></thead>
      <tbody>${w.changes.map((/** @type {any} */ each) => html`<tr key=${each.at_s}><td>${when(new Date(each.at_s * 1000).toISOString())}</td><td class="num">${each.size ? significant(each.size, 3) : "load"}</td><td>${STATES[each.state] ?? each.state}${each.load ? ", or a step of the load" : ""}</td><td class="num">${fixed(each.residual, 1)}</td><td class="num">${known(each.instead?.Ms) ? ms(each.instead.Ms) : ""}</td></tr>`)}</tbody></table>`}
    ${w.instead && html`<p class="note" key="instead">What fits instead: ${w.instead.message.replaceAll("+-", "±")}. The accepted gains have Ms <b>${w.instead.Ms < 100 ? ms(w.instead.Ms) : "over 100"}</b> then.${bad ? " The previous gains can be put back above." : ""}</p>`}
    <p class="quiet" key="how">${w.active ? `${w.changes.length} of ${w.requested} changes were compared. ${w.trouble ? "" : byItself(w)}` : (ENDS[w.end] ?? "")}</p>
  </section>`;
}

/** What the watch does by itself. @param {any} w */
function byItself(w) {
  if (!w.auto_rollback) return "The previous gains are not put back automatically.";
  if (w.auto_rollback_off) return `The previous gains are not put back automatically: ${w.auto_rollback_off}.`;
  return "The previous gains are put back automatically if PV leaves its limits or an oscillation grows.";
}
