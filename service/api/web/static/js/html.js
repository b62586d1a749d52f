// @ts-check
/** Templates without a build step. */
import { h } from "../vendor/preact.js";
import htm from "../vendor/htm.js";

/**
 * Makes the elements of a template.
 * `this[0] = 3` tells htm not to hand out the static parts of a template again: Preact writes their parents into them,
 * so that every tree that ever was would stay in memory.
 * @this {number[]}
 * @param {any} type
 * @param {any} props
 * @param {...any} children
 */
function element(type, props, ...children) {
  this[0] = 3;
  return h(type, props, ...children);
}

/** @type {(strings: TemplateStringsArray, ...values: any[]) => any} */
export const html = htm.bind(/** @type {any} */ (element));
