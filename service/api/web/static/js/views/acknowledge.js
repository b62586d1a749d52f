// @ts-check
/** Acknowledging an alarm: a person answers for it, under a name. */
import { signal } from "../../vendor/signals-core.js";
import { useEffect, useRef, useState } from "../../vendor/hooks.js";
import { command } from "../api.js";
import { html } from "../html.js";
import { isSilent, may, sign, signature } from "../state.js";

/** Id of the alarm whose question is open: one at a time. */
export const asking = signal("");

/** @param {import("../alarms.js").Alarm} alarm @returns what opens the question; null where the key or the alarm does not permit it. */
export function AcknowledgeButton(alarm) {
  if (!alarm.unacknowledged || !may.operate.value || asking.value === alarm.id) return null;
  return html`<button key="sign" class="acknowledge" disabled=${isSilent.value} aria-label=${`Acknowledge: ${alarm.subject}, ${alarm.text}`} onClick=${() => (asking.value = alarm.id)}>Acknowledge…</button>`;
}

/** @param {{alarm: import("../alarms.js").Alarm}} props */
export function AcknowledgeQuestion({ alarm }) {
  const field = useRef(/** @type {HTMLInputElement | null} */ (null));
  const [sending, setSending] = useState(false);
  const [problem, setProblem] = useState("");
  useEffect(() => {
    field.current?.focus();
    return () => {
      if (asking.peek() === alarm.id) asking.value = "";
    };
  }, []);
  const close = () => (asking.value = "");
  const dead = sending || isSilent.value || !signature.value.trim();
  const send = async () => {
    if (dead) return;
    setSending(true);
    setProblem("");
    try {
      await command(`/alarms/${encodeURIComponent(alarm.id)}/acknowledge`, { by: signature.value.trim() });
      close(); // the stream takes it off the list
    } catch (error) {
      setProblem(/** @type {Error} */ (error).message);
    }
    setSending(false);
  };
  const keys = (/** @type {KeyboardEvent} */ e) => {
    if (e.key === "Enter") void send();
    if (e.key === "Escape") close();
  };
  return html`<div class="acknowledge" role="group" aria-label=${`Acknowledge: ${alarm.subject}, ${alarm.text}`}>
    <span class="say">I have looked at <b>${alarm.subject}</b> and answer for it.</span>
    <label key="by">Your name <input ref=${field} type="text" maxlength="100" autocomplete="name" value=${signature.value} onInput=${(/** @type {any} */ e) => sign(e.target.value)} onKeyDown=${keys} /></label>
    <button key="cancel" onClick=${close}>Cancel</button><button key="go" class="main" disabled=${dead} onClick=${send}>Acknowledge</button>
    ${problem && html`<p key="problem" class="refusal" role="alert">${problem}</p>`}</div>`;
}
