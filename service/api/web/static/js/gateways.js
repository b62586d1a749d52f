// @ts-check
/** The gateways that share a database: which of them has a loop, and where its own page is. */
import { signal } from "../vendor/signals-core.js";
import { ask } from "./api.js";
import { html } from "./html.js";
import { service } from "./state.js";

/** As GET /gateways has them, by name; empty: not asked yet. */
const gateways = signal(/** @type {Map<string, any>} */ (new Map()));

/** Whether another gateway than the one that answers has the loop. @param {{gateway: string}} loop */
export const isElsewhere = (loop) => service.value !== null && service.value.gateway !== loop.gateway;

/** Asks which gateways there are. */
export async function refreshGateways() {
  try {
    const found = await ask("/gateways");
    gateways.value = new Map(found.map((/** @type {any} */ each) => [each.name, each]));
  } catch {
    // Names are shown without a link.
  }
}

/** The name of a loop's gateway, as a link to its page of the loop where its URL is known. @param {{gateway: string, tag: string}} loop */
export function GatewayName(loop) {
  const url = gateways.value.get(loop.gateway)?.url;
  const name = `gateway ${loop.gateway}`;
  return url ? html`<a href=${`${url}/ui/loops/${encodeURIComponent(loop.tag)}`}>${name}</a>` : name;
}
