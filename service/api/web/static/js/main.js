// @ts-check
/** Begins the page: routes, stream, palette, keys. */
import { render } from "../vendor/preact.js";
import "../vendor/signals.js";
import { effect } from "../vendor/signals-core.js";
import { abortJob } from "./aborting.js";
import { forbidden, signedOut } from "./api.js";
import { html } from "./html.js";
import { beginPalette } from "./palette.js";
import { beginRouting, decoded, go, path } from "./router.js";
import { jobs, may, refreshLoops, refreshSession } from "./state.js";
import { stream } from "./stream.js";
import { AlarmsView } from "./views/alarms.js";
import { Banner, Bar, Dock, dockLoop } from "./views/frame.js";
import { JobView } from "./views/job.js";
import { JobsView } from "./views/jobs.js";
import { KeysView, keysShown } from "./views/keys.js";
import { LogView } from "./views/log.js";
import { LoopView } from "./views/loop.js";
import { LoopsView } from "./views/loops.js";
import { BatchesView } from "./views/batches.js";
import { SignIn } from "./views/signin.js";

function View() {
  const at = path.value;
  const part = at.split("/").map(decoded);
  if (part[2] === "loops" && part[3]) return html`<${LoopView} key=${`loop ${part[3]}`} tag=${part[3]} />`;
  if (part[2] === "jobs" && part[3]) return html`<${JobView} key=${`job ${part[3]}`} id=${part[3]} />`;
  if (part[2] === "jobs") return html`<${JobsView} key="jobs" />`;
  if (part[2] === "batches") return html`<${BatchesView} key="batches" id=${part[3] ?? ""} />`;
  if (part[2] === "alarms") return html`<${AlarmsView} key="alarms" />`;
  if (part[2] === "log") return html`<${LogView} key="log" />`;
  return html`<${LoopsView} key="loops" />`;
}

function Page() {
  if (signedOut.value) return html`<${SignIn} key="signin" />`;
  return html`<a class="skip" href="#main" key="skip">To the content</a>
    <${Bar} key="bar" /><${Banner} key="banner" />
    <main id="main" key="main" tabindex="-1"><${View} key="view" /></main>
    <${Dock} key="dock" /><${KeysView} key="keys" />`;
}

let after = "";
addEventListener("keydown", (event) => {
  if ((event.ctrlKey || event.metaKey) && event.key === ".") {
    const running = jobs.value.filter((each) => !each.dry_run);
    const job = running.find((each) => each.loop === dockLoop.value) ?? (running.length === 1 ? running[0] : null);
    if (job && may.operate.value) {
      event.preventDefault();
      void abortJob(job);
    }
    return;
  }
  const typing = /** @type {Element} */ (event.target).closest?.("input, select, textarea");
  if (typing || event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.key === "?") keysShown.value = !keysShown.value;
  else if (event.key === "Escape") keysShown.value = false;
  else if (after === "g") {
    const to = /** @type {Record<string, string>} */ ({ l: "/ui/", j: "/ui/jobs", a: "/ui/alarms" })[event.key];
    if (to) go(to);
  }
  after = event.key;
});

function begin() {
  beginPalette();
  beginRouting();
  render(html`<${Page} />`, /** @type {Element} */ (document.getElementById("page")));
  let begun = false;
  effect(() => {
    if (signedOut.value) stream.end(); // signing in loads the page again
    else if (!begun) {
      begun = true;
      // Who is asking comes first: without a session the rest would be refused.
      void refreshSession().then(() => {
        if (signedOut.value) return;
        void refreshLoops();
        stream.begin();
      });
    }
  });
  effect(() => {
    if (forbidden.value) void refreshSession();
  });
}

begin();
