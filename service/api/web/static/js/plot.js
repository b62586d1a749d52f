// @ts-check
/** Plots on canvas: PV and SP above, MV below, one time axis and one cursor. Colours are tokens, read at each drawing. */
import uPlot from "../vendor/uPlot.js";
import { colour } from "./palette.js";
import { tick, timeOfDay } from "./numbers.js";

const FONT = "11px Inter, system-ui, sans-serif";
const LEFT = 56;
const RIGHT = 12;

/** Distance of ticks, 1, 2 or 5 times a power of ten. @param {number} range @param {number} most */
export function tickDistance(range, most) {
  const raw = range / Math.max(1, most);
  const power = 10 ** Math.floor(Math.log10(raw));
  const m = raw / power;
  return power * (m <= 1 ? 1 : m <= 2 ? 2 : m <= 5 ? 5 : 10);
}

/** @param {number} low @param {number} high @param {number} distance */
function ticks(low, high, distance) {
  const found = [];
  for (let n = Math.ceil(low / distance - 1e-9); n * distance <= high + 1e-9 * distance; n++) found.push(n * distance);
  return found;
}

/**
 * A range of y that follows the data but is never narrower than `minimum`.
 * @param {Iterable<ArrayLike<number>>} columns @param {number} minimum @returns {[number, number]}
 */
export function yRange(columns, minimum) {
  let low = Infinity;
  let high = -Infinity;
  for (const column of columns) {
    for (let n = 0; n < column.length; n++) {
      const value = column[n];
      if (value < low) low = value;
      if (value > high) high = value;
    }
  }
  if (!(low <= high)) return [0, minimum];
  const middle = (low + high) / 2;
  const half = Math.max((high - low) * 0.54, minimum / 2);
  return [middle - half, middle + half];
}

/**
 * @typedef {{label: string, colour: string, dash?: number[], width?: number, stepped?: boolean}} Line
 * @typedef {{lines: Line[], height: number, withTime: boolean, zero?: () => number | null, pace?: () => number, beneath?: (u: any, ctx: CanvasRenderingContext2D) => void,
 *   above?: (u: any, ctx: CanvasRenderingContext2D) => void, onCursor?: (u: any) => void, onSelect?: (from: number, to: number) => void, sync?: string}} PlotOptions
 */

/**
 * Where no line is drawn, in pixels: between the numbers beside one that is none. The plot itself knows null alone, which
 * a typed array cannot hold, and would draw a line across.
 * @param {any} u @param {ArrayLike<number>} at @param {ArrayLike<number>} values @param {number} first @param {number} last
 */
function gapsOf(u, at, values, first, last) {
  const found = [];
  for (let n = first; n <= last; n++) {
    if (!Number.isNaN(values[n])) continue;
    const from = Math.max(first, n - 1);
    while (n < last && Number.isNaN(values[n + 1])) n++;
    found.push([at[from], at[Math.min(last, n + 1)]].map((each) => Math.round(u.valToPos(each, "x", true))));
  }
  return found;
}

/**
 * Makes a plot. Words are drawn in `draw`: `drawClear` comes before the grid.
 * @param {HTMLElement} where @param {PlotOptions} options
 */
export function makePlot(where, options) {
  const axis = {
    stroke: () => colour("ink-2"),
    font: FONT,
    ticks: { show: false },
    grid: { stroke: () => colour("grid"), width: 1 },
  };
  const plot = new uPlot(
    {
      width: Math.max(200, where.clientWidth),
      height: options.height,
      pxAlign: true,
      legend: { show: false },
      padding: [8, RIGHT, options.withTime ? 0 : 8, 0],
      cursor: { sync: options.sync ? { key: options.sync, setSeries: false, scales: ["x", null] } : undefined, points: { show: false }, y: false, drag: { x: true, y: false, setScale: false } },
      scales: { x: { time: false, auto: false, range: (_u, low, high) => [low, high] }, y: { auto: false, range: (_u, low, high) => [low, high] } },
      axes: [
        {
          ...axis,
          show: true,
          size: options.withTime ? 24 : 0,
          splits: (u, _n, low, high) => {
            const zero = options.zero?.() ?? 0;
            const pace = options.pace?.() ?? 1; // seconds that are shown for one of the data
            const distance = tickDistance(pace * (high - low), Math.max(2, Math.floor(u.bbox.width / devicePixelRatio / 110)));
            return ticks(pace * (low - zero), pace * (high - zero), distance).map((value) => value / pace + zero);
          },
          values: (_u, splits) => {
            if (!options.withTime) return splits.map(() => "");
            const zero = options.zero?.() ?? null;
            const pace = options.pace?.() ?? 1;
            const distance = splits.length > 1 ? pace * (splits[1] - splits[0]) : 1;
            return splits.map((value) => (zero === null ? timeOfDay(value) : `${tick(pace * (value - zero), distance)} s`));
          },
        },
        {
          ...axis,
          size: LEFT,
          gap: 6,
          splits: (u, _n, low, high) => ticks(low, high, tickDistance(high - low, Math.max(3, Math.round(u.bbox.height / devicePixelRatio / 30)))),
          values: (_u, splits) => splits.map((value) => tick(value, splits.length > 1 ? splits[1] - splits[0] : Math.abs(value) || 1)),
        },
      ],
      series: [
        {},
        ...options.lines.map((line) => ({
          label: line.label,
          stroke: () => colour(line.colour),
          width: line.width ?? 1.5,
          dash: line.dash,
          points: { show: false },
          spanGaps: false,
          gaps: (/** @type {any} */ u, /** @type {number} */ of, /** @type {number} */ first, /** @type {number} */ last) => gapsOf(u, u.data[0], u.data[of], first, last),
          paths: line.stepped ? uPlot.paths.stepped?.({ align: 1 }) : undefined,
        })),
      ],
      hooks: {
        drawClear: [
          (u) => {
            u.ctx.save();
            u.ctx.fillStyle = colour("well");
            u.ctx.fillRect(u.bbox.left, u.bbox.top, u.bbox.width, u.bbox.height);
            u.ctx.beginPath();
            u.ctx.rect(u.bbox.left, u.bbox.top, u.bbox.width, u.bbox.height);
            u.ctx.clip();
            if (u.data[0].length) options.beneath?.(u, u.ctx); // without data the scale says nothing of the limits
            u.ctx.restore();
          },
        ],
        draw: [
          (u) => {
            if (!options.above) return;
            u.ctx.save();
            u.ctx.beginPath();
            u.ctx.rect(u.bbox.left, u.bbox.top, u.bbox.width, u.bbox.height);
            u.ctx.clip();
            options.above(u, u.ctx);
            u.ctx.restore();
          },
        ],
        setCursor: [(u) => options.onCursor?.(u)],
        setSelect: [
          (u) => {
            if (u.select.width < 6) return;
            const from = u.posToVal(u.select.left, "x");
            const to = u.posToVal(u.select.left + u.select.width, "x");
            u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
            options.onSelect?.(from, to);
          },
        ],
      },
    },
    [[], ...options.lines.map(() => [])],
    where,
  );
  const observer = new ResizeObserver(() => plot.setSize({ width: Math.max(200, where.clientWidth), height: plot.height }));
  observer.observe(where);
  return {
    plot,
    /** @param {ArrayLike<number>[]} data @param {[number, number]} x @param {[number, number]} y */
    show(data, x, y) {
      plot.batch(() => {
        plot.setData(/** @type {any} */ (data), false);
        plot.setScale("x", { min: x[0], max: x[1] });
        plot.setScale("y", { min: y[0], max: y[1] });
      });
    },
    redraw: () => plot.redraw(),
    destroy() {
      observer.disconnect();
      plot.destroy();
    },
  };
}

/** A dashed line with a name, at a time. @param {any} u @param {CanvasRenderingContext2D} ctx @param {number} at @param {string} name */
export function mark(u, ctx, at, name, row = 0) {
  const x = Math.round(u.valToPos(at, "x", true)) + 0.5;
  if (x < u.bbox.left - 1 || x > u.bbox.left + u.bbox.width) return;
  const ratio = devicePixelRatio;
  ctx.strokeStyle = colour("accent-soft");
  ctx.setLineDash([4 * ratio, 3 * ratio]);
  ctx.lineWidth = ratio;
  ctx.beginPath();
  ctx.moveTo(x, u.bbox.top);
  ctx.lineTo(x, u.bbox.top + u.bbox.height);
  ctx.stroke();
  ctx.setLineDash([]);
  if (!name) return;
  ctx.font = `${11 * ratio}px Inter, system-ui, sans-serif`;
  ctx.textAlign = "left";
  ctx.textBaseline = "top";
  const width = ctx.measureText(name).width + 6 * ratio;
  const fits = x + 2 * ratio + width <= u.bbox.left + u.bbox.width;
  const [left, top] = [fits ? x + 2 * ratio : x - 2 * ratio - width, u.bbox.top + (2 + 16 * row) * ratio];
  ctx.fillStyle = colour("well");
  ctx.globalAlpha = 0.85; // a curve behind it stays to be seen, and the name can be read
  ctx.fillRect(left, top, width, 15 * ratio);
  ctx.globalAlpha = 1;
  ctx.fillStyle = colour("ink-2");
  ctx.fillText(name, left + 3 * ratio, top + 2 * ratio);
}

/** Hatched ground, beyond a limit. @param {any} u @param {CanvasRenderingContext2D} ctx @param {number} from @param {number} to */
export function hatched(u, ctx, from, to) {
  const a = u.valToPos(from, "y", true);
  const b = u.valToPos(to, "y", true);
  const top = Math.max(Math.min(a, b), u.bbox.top);
  const bottom = Math.min(Math.max(a, b), u.bbox.top + u.bbox.height);
  if (!(bottom > top)) return;
  ctx.save();
  ctx.beginPath();
  ctx.rect(u.bbox.left, top, u.bbox.width, bottom - top);
  ctx.clip();
  ctx.strokeStyle = colour("hatch");
  ctx.lineWidth = devicePixelRatio;
  const step = 7 * devicePixelRatio;
  ctx.beginPath();
  for (let x = u.bbox.left - (bottom - top); x < u.bbox.left + u.bbox.width; x += step) {
    ctx.moveTo(x, bottom);
    ctx.lineTo(x + bottom - top, top);
  }
  ctx.stroke();
  ctx.restore();
}
