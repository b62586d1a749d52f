// @ts-check
/** The audit log: who changed what. */
import { useEffect, useState } from "../../vendor/hooks.js";
import { askPage } from "../api.js";
import { html } from "../html.js";
import { when } from "../numbers.js";
import { jobPath, loopPath } from "../router.js";

export function LogView() {
  const [entries, setEntries] = useState(/** @type {any[] | null} */ (null));
  const [next, setNext] = useState(/** @type {string | null} */ (null));
  const [problem, setProblem] = useState("");
  const look = async (/** @type {string} */ path, /** @type {any[]} */ before) => {
    try {
      const page = await askPage(path);
      setEntries([...before, ...page.entries]);
      setNext(page.next);
    } catch (error) {
      setProblem(/** @type {Error} */ (error).message);
    }
  };
  useEffect(() => {
    document.title = "Log · Loopwright";
    void look("/audit?limit=100", []);
  }, []);
  return html`<div><div class="pagehead" key="head"><h1>Log</h1><span class="sentence">who changed what, and with which key</span></div>
    ${problem && html`<p class="refusal" role="alert" key="problem">${problem}</p>`}
    ${!entries ? !problem && html`<p class="calm" role="status" key="wait">Asking for the log…</p>` : !entries.length ? html`<p class="calm" key="none">Nothing was changed yet.</p>` : html`<div class="table" key="table"><table><thead><tr><th>Date</th><th>What</th><th>Loop</th><th>Of</th><th>Key</th><th>By</th><th>From</th></tr></thead>
      <tbody>${entries.map((each) => html`<tr key=${each.number}><td title=${each.at}>${when(each.at)}</td><td><b>${each.what.replaceAll("_", " ")}</b></td><td>${each.loop && html`<a class="tag" href=${loopPath(each.loop)}>${each.loop}</a>`}</td><td>${/^[0-9a-f]{12}$/.test(each.subject ?? "") && each.loop ? html`<a href=${jobPath(`/jobs/${each.subject}`)}>job ${each.subject}</a>` : each.subject}</td><td>${each.key}</td><td>${each.by}</td><td class="quiet">${each.address}</td></tr>`)}</tbody></table></div>`}
    ${next && html`<p class="foot" key="more"><button onClick=${() => look(String(next), entries ?? [])}>More</button></p>`}</div>`;
}
