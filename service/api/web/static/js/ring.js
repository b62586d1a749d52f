// @ts-check
/**
 * The latest samples of one loop, in typed arrays which a plot takes as they are. A gap is a sample of NaN. Of a fast loop the
 * older ones are thinned, again and again, so that the longest window has its beginning.
 */

const ROOM = 40_000;
/** Four samples over so long are thinned no more: a pixel of the longest window is two seconds. */
const COARSE_S = 3;
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
    if (this.length >= this.room) this.thin();
    if (this.end === 2 * this.room) {
      for (const column of this.columns) column.copyWithin(0, this.begin, this.end);
      this.end -= this.begin;
      this.begin = 0;
    }
    const n = this.end++;
    this.at[n] = at;
    this.pv[n] = pv ?? NaN;
    this.sp[n] = sp ?? NaN;
    this.mv[n] = mv ?? NaN;
  }

  get columns() {
    return [this.at, this.pv, this.sp, this.mv];
  }

  /** Thins the older half: of each four samples those of the least and of the largest PV stay, and a gap with its neighbours. */
  thin() {
    const half = this.begin + (this.length >> 1);
    let to = half; // from the newer end on, so that none is written over that is still to be looked at
    for (let last = half; last > this.begin; last -= 4) {
      const first = Math.max(this.begin, last - 4);
      let [low, high] = [first, first];
      let stays = this.at[last - 1] - this.at[first] >= COARSE_S; // as thin as it may be
      for (let n = first; n < last; n++) {
        stays ||= Number.isNaN(this.pv[n]);
        if (this.pv[n] < this.pv[low]) low = n;
        if (this.pv[n] >= this.pv[high]) high = n;
      }
      for (let n = last - 1; n >= first; n--) {
        if (!stays && n !== low && n !== high) continue;
        to--;
        for (const column of this.columns) column[to] = column[n];
      }
    }
    const least = this.room >> 3; // where no more is thinned the oldest go
    this.begin = Math.max(to, this.begin + least);
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
