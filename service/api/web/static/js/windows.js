// @ts-check
/**
 * The streams of this browser's windows. A browser makes six connections to a service, each stream keeps one, and a
 * further window would wait for ever: where there are too many, the windows that nobody sees give theirs up.
 */

/** One connection is left for the next page, and for what is asked of the service. */
const MAX_STREAMS = 5;

/** @typedef {{said: "opened" | "open" | "crowded", by: string, to?: string}} Message */

export class Windows {
  /** @param {() => boolean} isOpen whether this window has a stream. @param {() => void} crowded called where there are too many */
  constructor(isOpen, crowded) {
    this.name = Math.random().toString(36);
    /** @type {Set<string>} */
    this.others = new Set();
    this.channel = new BroadcastChannel("loopwright");
    this.channel.addEventListener("message", (event) => {
      const { said, by, to } = /** @type {Message} */ (event.data);
      if (said === "crowded") crowded();
      else if (said === "opened" && isOpen()) this.say("open", by);
      else if (said === "open" && to === this.name) this.count(by);
    });
  }

  /** Says that this window opens a stream; the others say whether they have one. */
  opened() {
    this.others.clear();
    this.say("opened");
  }

  /** @param {string} by */
  count(by) {
    this.others.add(by);
    if (this.others.size + 1 <= MAX_STREAMS) return;
    this.others.clear();
    this.say("crowded");
  }

  /** @param {Message["said"]} said @param {string} [to] the window that has opened a stream */
  say(said, to) {
    this.channel.postMessage({ said, by: this.name, to });
  }
}
