// @ts-check
/** Signing in with an API key. The key is sent once; the browser keeps the cookie of the session, the page keeps nothing. */
import { useEffect, useRef, useState } from "../../vendor/hooks.js";
import { command } from "../api.js";
import { html } from "../html.js";
import { session } from "../state.js";

export function SignIn() {
  const [problem, setProblem] = useState("");
  const [sending, setSending] = useState(false);
  const field = useRef(/** @type {HTMLInputElement | null} */ (null));
  const wasIn = session.peek() !== null;
  useEffect(() => {
    document.title = "Sign in · Loopwright";
    document.body.classList.remove("docked");
    field.current?.focus();
  }, []);
  const send = async (/** @type {any} */ event) => {
    event.preventDefault();
    setSending(true);
    setProblem("");
    try {
      await command("/session", { key: field.current?.value.trim() ?? "" });
      location.reload(); // to where one was
    } catch (error) {
      setProblem(words(/** @type {import("../api.js").Problem} */ (error)));
      setSending(false);
      field.current?.select();
    }
  };
  return html`<main><form class="card signin" onSubmit=${send}><h1 key="title">Sign in to Loopwright</h1>
    ${wasIn && html`<p key="over" role="status">The session is over: it has ended, or its key was revoked. Tests that run go on.</p>`}
    <input key="user" class="hidden-words" type="text" name="username" autocomplete="username" value="Loopwright" readonly tabindex="-1" aria-hidden="true" />
    <label key="key" class="field"><span>API key</span><input ref=${field} name="key" type="password" autocomplete="current-password" spellcheck="false" required
      aria-invalid=${problem ? "true" : undefined} aria-describedby=${problem ? "signin-problem" : undefined} /></label>
    <p key="how" class="quiet">An administrator makes a key with <code>loopwright key create</code>.</p>
    ${problem && html`<p class="refusal" role="alert" id="signin-problem" key="problem">${problem}</p>`}
    <p key="foot" class="foot"><button class="main" disabled=${sending}>${sending ? "Signing in…" : "Sign in"}</button></p></form></main>`;
}

/** @param {import("../api.js").Problem} problem */
function words(problem) {
  if (problem.status === 401) return "This key is not known, was revoked or has expired.";
  if (problem.status === 429 && problem.retryAfter_s) return `Too many wrong keys from here: try again in ${problem.retryAfter_s} s.`;
  return problem.message;
}
