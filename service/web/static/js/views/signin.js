// @ts-check
/** Signing in with an API key. The key is sent once, a cookie is kept. */
import { useState } from "../../vendor/hooks.js";
import { signedOut } from "../api.js";
import { html } from "../html.js";

export function SignIn() {
  const [problem, setProblem] = useState("");
  const [sending, setSending] = useState(false);
  const send = async (/** @type {any} */ event) => {
    event.preventDefault();
    const key = String(new FormData(event.target).get("key") ?? "").trim();
    setSending(true);
    setProblem("");
    try {
      const answer = await fetch("/session", { method: "POST", headers: { Authorization: `Bearer ${key}`, "X-Loopwright": "1" } });
      if (answer.ok) {
        signedOut.value = false;
        location.reload(); // to where one was
        return;
      }
      const found = await answer.json().catch(() => null);
      setProblem(answer.status === 401 ? "This key is not known, was revoked or has expired." : (found?.detail ?? `The service answers ${answer.status}.`));
    } catch {
      setProblem("The service does not answer.");
    }
    setSending(false);
  };
  return html`<main><form class="card signin" onSubmit=${send}><h1>Sign in to Loopwright</h1>
    <label class="field"><span>API key</span><input name="key" type="password" autocomplete="current-password" required autofocus /></label>
    <p class="quiet">An administrator makes a key with <code>loopwright keys create</code>.</p>
    ${problem && html`<p class="refusal" role="alert" key="problem">${problem}</p>`}
    <p class="foot"><button class="main" disabled=${sending}>Sign in</button></p></form></main>`;
}
