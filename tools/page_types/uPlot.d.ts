/** What the page uses of uPlot, for the type checker alone: the library comes without declarations here. */

type Numbers = ArrayLike<number | null | undefined>;
type Limits = [number, number];

interface Scale {
  time?: boolean;
  auto?: boolean;
  range?: (plot: uPlot, low: number, high: number) => Limits;
}

interface Axis {
  side?: number;
  size?: number;
  gap?: number;
  font?: string;
  stroke?: string | (() => string);
  grid?: { stroke?: string | (() => string); width?: number };
  ticks?: { show?: boolean };
  splits?: (plot: uPlot, axis: number, low: number, high: number) => number[];
  values?: (plot: uPlot, splits: number[]) => string[];
  [option: string]: unknown;
}

type Hook = (plot: uPlot) => void;

interface Options {
  width: number;
  height: number;
  scales?: Record<string, Scale>;
  axes?: Axis[];
  series: Record<string, unknown>[];
  hooks?: Record<string, Hook[]>;
  [option: string]: unknown;
}

export default class uPlot {
  constructor(options: Options, data: Numbers[], into?: HTMLElement);
  static paths: { stepped?: (options: { align: 1 | -1 }) => unknown };
  readonly bbox: { left: number; top: number; width: number; height: number };
  readonly ctx: CanvasRenderingContext2D;
  readonly cursor: { idx?: number | null; left?: number; top?: number };
  readonly data: Numbers[];
  readonly over: HTMLElement;
  readonly root: HTMLElement;
  readonly select: { left: number; top: number; width: number; height: number };
  readonly scales: Record<string, { min?: number; max?: number }>;
  readonly width: number;
  readonly height: number;
  batch(change: () => void): void;
  destroy(): void;
  posToVal(position: number, scale: string): number;
  redraw(rebuildPaths?: boolean, recalculateAxes?: boolean): void;
  setCursor(to: { left: number; top: number }, tell?: boolean): void;
  setData(data: Numbers[], resetScales?: boolean): void;
  setScale(scale: string, limits: { min: number; max: number }): void;
  setSelect(to: { left: number; top: number; width: number; height: number }, tell?: boolean): void;
  setSize(size: { width: number; height: number }): void;
  valToPos(value: number, scale: string, canvas?: boolean): number;
}
