// @ts-check
/** What is abnormal now, looked at with each beat of the stream. */
import { effect, signal } from "../vendor/signals-core.js";
import { abnormal } from "./alarms.js";
import { alarms, beat, buses, isSilent, loops, now_s, rowOf } from "./state.js";

export const abnormalNow = signal(/** @type {import("./alarms.js").Alarm[]} */ ([]));

export function beginWatching() {
  effect(() => {
    beat.value;
    const told = alarms.value;
    const found = told
      ? told.map((each) => ({ key: each.id, level: each.level, loop: each.loop, words: each.words, since_s: Date.parse(each.since) / 1000 }))
      : abnormal(loops.value?.values() ?? [], (tag) => rowOf(tag).peek(), buses.value, now_s.peek());
    const silent = isSilent.value ? [{ key: "silent", level: /** @type {2} */ (2), loop: null, words: "No word from the service", since_s: now_s.peek() }] : [];
    const all = [...silent, ...found];
    const same = (/** @type {any[]} */ list) => list.map((each) => `${each.key}${each.words}`).join("|");
    if (same(all) !== same(abnormalNow.peek())) abnormalNow.value = all;
  });
}
