// @ts-check
/** The latest samples of one loop, in typed arrays which a plot takes as they are. A gap is a sample of NaN. */

const ROOM = 40_000;
/** Samples come in order: one that is earlier than the latest by more than this says that the service's clock was put back. */
export const SET_BACK_S = 2;

export class Ring {
  /** @param {number} room */
  constructor(room = ROOM) {
    this.room = room;
    // Twice the room: the newest are always in one piece.
    this.at = new Float64Array(2 * room);
    this.pv = new Float64Array(2 * room);
    this.sp = new Float64Array(2 * room);
    this.mv = new Float64Array(2 * room);
    this.begin = 0;
    this.end = 0;
  }

  clear() {
    this.begin = 0;
    this.end = 0;
  }

  get length() {
    return this.end - this.begin;
  }

  /** The wall time of the latest sample, s; NaN: there is none. */
  get last() {
    return this.end > this.begin ? this.at[this.end - 1] : NaN;
  }

  /** @param {number} at @param {number | null} pv @param {number | null} sp @param {number | null} mv */
  push(at, pv, sp, mv) {
    if (!(at > this.last) && this.length) return; // had already
    if (this.end === 2 * this.room) {
      for (const column of [this.at, this.pv, this.sp, this.mv]) column.copyWithin(0, this.end - this.room + 1, this.end);
      this.end = this.room - 1;
      this.begin = 0;
    }
    const n = this.end++;
    this.at[n] = at;
    this.pv[n] = pv ?? NaN;
    this.sp[n] = sp ?? NaN;
    this.mv[n] = mv ?? NaN;
    if (this.length > this.room) this.begin = this.end - this.room;
  }

  /** A gap after the latest sample: no line is drawn across. */
  gap() {
    if (this.length && !(Number.isNaN(this.pv[this.end - 1]) && Number.isNaN(this.mv[this.end - 1]))) {
      this.push(this.last + 1e-3, null, null, null);
    }
  }

  /** The service's clock was put back: what it has called later is let go, or nothing would be drawn until then. @param {number} at */
  setBack(at) {
    while (this.length && this.at[this.end - 1] >= at) this.end--;
    this.gap();
  }

  /**
   * Takes a message `samples` of the live stream.
   * @param {{past: boolean, at_s: number[], pv: (number|null)[], sp: (number|null)[], mv: (number|null)[], gap_before: number[]}} found
   */
  take(found) {
    const gaps = new Set(found.gap_before);
    if (!found.past && found.at_s[0] < this.last - SET_BACK_S) this.setBack(found.at_s[0]);
    for (let n = 0; n < found.at_s.length; n++) {
      if (gaps.has(n)) this.gap();
      this.push(found.at_s[n], found.pv[n], found.sp[n], found.mv[n]);
    }
  }

  /**
   * The samples from a wall time on, one more at the left, without copying.
   * @param {number} from_s
   */
  since(from_s) {
    let low = this.begin;
    let high = this.end;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.at[middle] < from_s) low = middle + 1;
      else high = middle;
    }
    const first = Math.max(this.begin, low - 1);
    return {
      at: this.at.subarray(first, this.end),
      pv: this.pv.subarray(first, this.end),
      sp: this.sp.subarray(first, this.end),
      mv: this.mv.subarray(first, this.end),
    };
  }
}
