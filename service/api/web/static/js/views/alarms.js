// @ts-check
/** The active alarms, and nothing else. Meant to stay open. */
import { useEffect } from "../../vendor/hooks.js";
import { activeAlarms } from "../alarms.js";
import { isElsewhere } from "../gateways.js";
import { html } from "../html.js";
import { duration, when } from "../numbers.js";
import { jobPath, loopPath } from "../router.js";
import { isSilent, loops, now_s } from "../state.js";
import { stream } from "../stream.js";
import { AlarmSymbol } from "../symbols.js";
import { asking, AcknowledgeButton, AcknowledgeQuestion } from "./acknowledge.js";

export function AlarmsView() {
  const all = activeAlarms.value;
  document.title = all?.length ? `(${all.length}) Loopwright` : "Loopwright";
  useEffect(() => {
    /** @type {any} */
    let lock = null;
    const wake = async () => {
      try {
        if (!document.hidden) lock = await navigator.wakeLock?.request("screen");
      } catch {
        // The browser does not keep the screen awake.
      }
    };
    void wake();
    stream.stays = true; // the title counts, also where it is all that is seen of the page
    document.addEventListener("visibilitychange", wake);
    return () => {
      stream.stays = false;
      document.removeEventListener("visibilitychange", wake);
      lock?.release();
    };
  }, []);
  if (!all) return html`<p class="calm" role="status">Asking for the alarms…</p>`;
  if (!all.length) return html`<p class="calm" role="status">No active alarms.</p>`;
  return html`<div><div class="pagehead" key="head"><h1>Alarms</h1></div><div class="table alarms" key="table"><table><thead><tr><th>Priority</th><th>Where</th><th>What</th><th>Since</th><th class="c-description">Description</th><th class="c-area">Area</th><th><span class="hidden-words">Acknowledge</span></th></tr></thead>
    <tbody>${all.flatMap((each) => {
      const loop = each.loop ? loops.value?.get(each.loop) : null;
      const old = isSilent.value && each.id !== "silent";
      const row = html`<tr key=${each.id} class=${old ? "old" : ""}><td>${AlarmSymbol(each.priority)}</td><td>${Subject(each)}</td>
        <td class="what"><b>${each.text}</b> ${each.job && html`<a key="job" href=${jobPath(each.job)}>the job</a>`}<small key="advice">${each.advice}</small></td>
        <td class="since" title=${when(each.since)}>${old ? when(each.since) : duration(Math.max(0, now_s.value - Date.parse(each.since) / 1000))}</td>
        <td class="c-description">${loop?.description}</td><td class="c-area">${loop?.area}</td><td class="do">${AcknowledgeButton(each)}</td></tr>`;
      return asking.value === each.id ? [row, html`<tr key=${`sign ${each.id}`} class="question"><td colspan="7"><${AcknowledgeQuestion} alarm=${each} /></td></tr>`] : [row];
    })}</tbody></table></div></div>`;
}

/** A loop; or a bus, a node or a gateway, with the loops that it concerns. @param {import("../alarms.js").Alarm} alarm */
function Subject(alarm) {
  if (alarm.loop) return html`<a class="tag" href=${loopPath(alarm.loop)}>${alarm.loop}</a>`;
  const shown = alarm.loops.slice(0, MOST);
  const more = alarm.loops.length - shown.length;
  const at = alarm.gateway && alarm.kind !== "gateway_offline" && isElsewhere({ gateway: alarm.gateway }) ? ` of gateway ${alarm.gateway}` : "";
  return html`<span key="of">${alarm.subject}${at}</span>${shown.length > 0 && html`<small key="loops">${shown.map((tag, n) => html`${n ? ", " : ""}<a class="tag" href=${loopPath(tag)}>${tag}</a>`)}${more > 0 ? ` and ${more} more` : ""}</small>`}`;
}

const MOST = 6;
