// @ts-check
/**
 * Steps and margins of a loop, for pictures: gains and decisions are the service's. Pure.
 *
 * A model is num/den in powers of s, the highest first, with a dead time; PV units per percent of MV. Gains are in ISA form,
 * Kp positive: the direction of action is the controller's, so a model of negative gain counts as its mirror image.
 *
 * @typedef {{num: number[], den: number[], dead_time_s: number}} Model
 * @typedef {{Kp: number, Ti: number, Td?: number, Tf?: number, b?: number, c?: number}} Gains
 */

/**
 * The model of a job, of either procedure; null: there is none.
 * @param {any} found
 * @param {number} delay_s which the sampled loop has beside the model, s
 * @returns {Model | null}
 */
export function modelOf(found, delay_s = 0) {
  if (!found) return null;
  const model = continuous(found);
  return { ...model, dead_time_s: model.dead_time_s + delay_s };
}

/** @param {any} found @returns {Model} */
function continuous(found) {
  if (found.num) return { num: found.num, den: found.den, dead_time_s: found.dead_time_s };
  const { K, T_s, L_s, zeta } = found;
  if (typeof zeta === "number") return { num: [K], den: [T_s * T_s, 2 * zeta * T_s, 1], dead_time_s: L_s };
  return { num: [K], den: [T_s, 1], dead_time_s: L_s };
}

/** +1, or −1 where PV falls as MV rises. @param {Model} model */
export function direction(model) {
  for (let n = model.num.length - 1; n >= 0; n--) if (model.num[n] !== 0) return Math.sign(model.num[n]);
  return 1;
}

/** @param {number[]} p @param {number} re @param {number} im @returns {[number, number]} */
function polynomial(p, re, im) {
  let [a, b] = [0, 0];
  for (const each of p) [a, b] = [a * re - b * im + each, a * im + b * re];
  return [a, b];
}

/** @param {[number, number]} x @param {[number, number]} y @returns {[number, number]} */
function divided(x, y) {
  const size = y[0] * y[0] + y[1] * y[1];
  return [(x[0] * y[0] + x[1] * y[1]) / size, (x[1] * y[0] - x[0] * y[1]) / size];
}

/** @param {[number, number]} x @param {[number, number]} y @returns {[number, number]} */
function times(x, y) {
  return [x[0] * y[0] - x[1] * y[1], x[0] * y[1] + x[1] * y[0]];
}

/** L(jw). @param {Model} model @param {Gains} g @param {number} w @returns {[number, number]} */
export function openLoop(model, g, w) {
  const plant = divided(polynomial(model.num, 0, w), polynomial(model.den, 0, w));
  const delay = /** @type {[number, number]} */ ([Math.cos(w * model.dead_time_s), -Math.sin(w * model.dead_time_s)]);
  let controller = /** @type {[number, number]} */ ([1, g.Ti > 0 ? -1 / (w * g.Ti) : 0]);
  if (g.Td) {
    const d = divided([0, w * g.Td], [1, w * (g.Tf ?? 0)]);
    controller = [controller[0] + d[0], controller[1] + d[1]];
  }
  const k = direction(model) * g.Kp;
  return times(times(plant, delay), [k * controller[0], k * controller[1]]);
}

/** How long the loop takes, roughly, s. @param {Model} model @param {Gains} g */
export function slowness(model, g) {
  const n = model.den.length;
  const last = model.den[n - 1];
  const lag = n > 1 ? Math.abs(last) > 1e-12 ? Math.abs(model.den[n - 2] / last) : Math.abs((model.den[n - 3] ?? 0) / model.den[n - 2]) : 0;
  return Math.max(model.dead_time_s + lag, g.Ti * 0.2, 1e-3);
}

/**
 * @param {Model} model @param {Gains} g
 * @returns {{Ms: number, GM: number | null, PM_deg: number | null, delay_margin_s: number | null, w: Float64Array, re: Float64Array, im: Float64Array}}
 */
export function frequency(model, g, points = 1600) {
  const scale = slowness(model, g);
  const low = Math.log(0.005 / scale);
  const high = Math.log(Math.max(400 / scale, 12 / Math.max(model.dead_time_s, scale / 100)));
  const w = new Float64Array(points);
  const re = new Float64Array(points);
  const im = new Float64Array(points);
  let least = Infinity;
  /** @type {number | null} */
  let GM = null;
  /** @type {number | null} */
  let PM_deg = null;
  /** @type {number | null} */
  let delay_margin_s = null;
  for (let n = 0; n < points; n++) {
    w[n] = Math.exp(low + ((high - low) * n) / (points - 1));
    [re[n], im[n]] = openLoop(model, g, w[n]);
    least = Math.min(least, Math.hypot(1 + re[n], im[n]));
    if (!n) continue;
    if (im[n - 1] < 0 !== im[n] < 0 && re[n] < 0 && re[n - 1] < 0) {
      const part = im[n - 1] / (im[n - 1] - im[n]);
      const at = re[n - 1] + part * (re[n] - re[n - 1]);
      const gm = -1 / at;
      if (at > -1 && (GM === null || gm < GM)) GM = gm;
    }
    const before = Math.hypot(re[n - 1], im[n - 1]);
    const size = Math.hypot(re[n], im[n]);
    if (before >= 1 !== size >= 1) {
      const part = (before - 1) / (before - size);
      const [x, y] = [re[n - 1] + part * (re[n] - re[n - 1]), im[n - 1] + part * (im[n] - im[n - 1])];
      let angle = Math.atan2(y, x) + Math.PI;
      if (angle > Math.PI * 1.5) angle -= 2 * Math.PI;
      const at = w[n - 1] + part * (w[n] - w[n - 1]);
      const pm = (angle * 180) / Math.PI;
      if (PM_deg === null || pm < PM_deg) PM_deg = pm;
      if (angle > 0 && (delay_margin_s === null || angle / at < delay_margin_s)) delay_margin_s = angle / at;
    }
  }
  return { Ms: 1 / least, GM, PM_deg, delay_margin_s, w, re, im };
}

/** The plant alone, from rest: PV's deviation for the deviation of MV, held from each sample to the next. */
export class Plant {
  /** @param {Model} model @param {number} dt_s */
  constructor(model, dt_s) {
    const lead = model.den[0];
    this.a = model.den.slice(1).map((each) => each / lead);
    const order = this.a.length;
    const num = model.num.map((each) => each / lead);
    this.direct = num.length > order ? num[0] : 0;
    const padded = [...new Array(Math.max(0, order + 1 - num.length)).fill(0), ...num];
    this.c = padded.slice(1).map((each, n) => each - this.direct * this.a[n]);
    this.x = new Float64Array(order);
    this.dt = dt_s;
    const delay = model.dead_time_s / dt_s;
    this.whole = Math.floor(delay + 1e-9);
    this.part = delay - this.whole;
    this.held = new Float64Array(this.whole + 2);
    this.n = 0;
  }

  /** @param {Float64Array} x @param {number} u @param {Float64Array} out */
  slope(x, u, out) {
    let first = u;
    for (let n = 0; n < x.length; n++) first -= this.a[n] * x[n];
    out[0] = first;
    for (let n = 1; n < x.length; n++) out[n] = x[n - 1];
  }

  get output() {
    let y = 0;
    for (let n = 0; n < this.x.length; n++) y += this.c[n] * this.x[n];
    return y;
  }

  /** @param {number} u held during the step @returns {number} the output after it */
  step(u) {
    const room = this.held.length;
    this.held[this.n % room] = u;
    const now = this.held[(this.n - this.whole + room) % room];
    const older = this.held[(this.n - this.whole - 1 + 2 * room) % room];
    this.n++;
    this.advance(older, this.part * this.dt);
    this.advance(now, (1 - this.part) * this.dt);
    return this.output + this.direct * now;
  }

  /** @param {number} u @param {number} dt */
  advance(u, dt) {
    if (dt <= 0 || !this.x.length) return;
    const order = this.x.length;
    const stiff = Math.max(1, ...this.a.map((each, n) => Math.abs(each) ** (1 / (n + 1))));
    const parts = Math.min(20, Math.max(1, Math.ceil(dt * stiff)));
    const h = dt / parts;
    const [k1, k2, k3, k4, y] = [0, 0, 0, 0, 0].map(() => new Float64Array(order));
    for (let p = 0; p < parts; p++) {
      this.slope(this.x, u, k1);
      for (let n = 0; n < order; n++) y[n] = this.x[n] + (h / 2) * k1[n];
      this.slope(y, u, k2);
      for (let n = 0; n < order; n++) y[n] = this.x[n] + (h / 2) * k2[n];
      this.slope(y, u, k3);
      for (let n = 0; n < order; n++) y[n] = this.x[n] + h * k3[n];
      this.slope(y, u, k4);
      for (let n = 0; n < order; n++) this.x[n] += (h / 6) * (k1[n] + 2 * k2[n] + 2 * k3[n] + k4[n]);
    }
  }
}

/**
 * The answer of the loop to a set-point step (PV units) or a load at the plant's input (percent of MV), from rest.
 * @param {Model} model @param {Gains} g @param {{setpoint?: number, load?: number}} of @param {number} horizon_s
 * @returns {{t: Float64Array, y: Float64Array, IAE: number, overshoot_pct: number, settling_s: number | null}}
 */
export function step(model, g, of, horizon_s, points = 600) {
  const dt = horizon_s / points;
  const sign = direction(model);
  const plant = new Plant(model, dt);
  const r = of.setpoint ?? 0;
  const t = new Float64Array(points + 1);
  const y = new Float64Array(points + 1);
  let I = 0;
  let pv = 0;
  let IAE = 0;
  const filter = (g.Tf ?? 0) / ((g.Tf ?? 0) + dt);
  const kick = g.Td ? g.Td / ((g.Tf ?? 0) + dt) : 0;
  let D = 0;
  let before = 0;
  for (let n = 0; n <= points; n++) {
    t[n] = n * dt;
    y[n] = pv;
    const e = r - pv;
    IAE += Math.abs(e) * dt;
    const d = (g.c ?? 0) * r - pv;
    D = filter * D + kick * (d - before);
    before = d;
    const u = sign * g.Kp * ((g.b ?? 1) * r - pv + I + D);
    if (g.Ti > 0) I += (e * dt) / g.Ti;
    pv = Math.max(-1e6, Math.min(1e6, plant.step(u + (of.load ?? 0))));
  }
  let most = 0;
  for (const each of y) most = Math.max(most, r ? each / r : Math.abs(each));
  const band = 0.05 * (r ? Math.abs(r) : most);
  let last = points;
  while (last >= 0 && Math.abs(y[last] - r) <= band) last--;
  return { t, y, IAE, overshoot_pct: r ? Math.max(0, (most - 1) * 100) : 0, settling_s: last >= points ? null : t[last + 1] };
}

/**
 * Gains between designs, by the logarithms of Kp, Ti and Td.
 * @param {{ms: number, gains: Gains}[]} designs in order of Ms @param {number} ms @returns {Gains | null} null: none, or outside them
 */
export function between(designs, ms) {
  const after = designs.findIndex((each) => each.ms >= ms - 1e-9);
  if (after < 0) return null;
  if (Math.abs(designs[after].ms - ms) < 1e-9) return designs[after].gains;
  if (after === 0) return null;
  const [a, b] = [designs[after - 1], designs[after]];
  const part = (ms - a.ms) / (b.ms - a.ms);
  const mix = (/** @type {number} */ x, /** @type {number} */ y) => (x > 0 && y > 0 ? Math.exp(Math.log(x) + part * Math.log(y / x)) : x + part * (y - x));
  const [p, q] = [a.gains, b.gains];
  return { Kp: mix(p.Kp, q.Kp), Ti: mix(p.Ti, q.Ti), Td: mix(p.Td ?? 0, q.Td ?? 0), Tf: mix(p.Tf ?? 0, q.Tf ?? 0), b: mix(p.b ?? 1, q.b ?? 1), c: p.c };
}
