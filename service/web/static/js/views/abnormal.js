// @ts-check
/** What is abnormal, and nothing else. Meant to stay open. */
import { useEffect } from "../../vendor/hooks.js";
import { html } from "../html.js";
import { duration, when } from "../numbers.js";
import { loopPath } from "../router.js";
import { loops, now_s } from "../state.js";
import { AlarmSymbol } from "../symbols.js";
import { abnormalNow } from "../watching.js";

export function AbnormalView() {
  const all = abnormalNow.value;
  document.title = `${all.length ? `(${all.length}) ` : ""}Abnormal · Loopwright`;
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
    document.addEventListener("visibilitychange", wake);
    return () => {
      document.removeEventListener("visibilitychange", wake);
      lock?.release();
    };
  }, []);
  if (!loops.value) return html`<p class="calm" role="status">Asking for the loops…</p>`;
  if (!all.length) return html`<p class="calm">Nothing is abnormal.</p>`;
  return html`<div><div class="pagehead" key="head"><h1>Abnormal</h1></div><div class="table" key="table"><table><thead><tr><th>Level</th><th>Loop</th><th>What</th><th>Since</th><th>Description</th><th>Area</th></tr></thead>
    <tbody>${all.map((each) => {
      const loop = each.loop ? loops.value?.get(each.loop) : null;
      return html`<tr key=${each.key}><td>${AlarmSymbol(each.level)}</td><td>${each.loop ? html`<a class="tag" href=${loopPath(each.loop)}>${each.loop}</a>` : ""}</td><td><b>${each.words}</b></td>
        <td title=${when(new Date(each.since_s * 1000).toISOString())}>${duration(Math.max(0, now_s.value - each.since_s))}</td><td>${loop?.description}</td><td>${loop?.area}</td></tr>`;
    })}</tbody></table></div></div>`;
}
