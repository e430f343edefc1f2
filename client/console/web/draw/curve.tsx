import {effect} from '@preact/signals';
import {useEffect, useRef} from 'preact/hooks';
import uPlot from 'uplot';

import {dark} from '../theme.js';
import {type Colour, colourOf} from './scene.js';

export interface Series {
  label: string;
  colour: Colour;
  /** One for each x; null where there is none. */
  values: Array<number|null>;
  /** How it is drawn; points are for values that stand for themselves. */
  as: 'line'|'points'|'dashes';
}

export interface Curve {
  title: string;
  /** The quantity along x, with its unit. */
  xLabel: string;
  x: number[];
  /** The part of x that is shown; undefined for all that there is. */
  xRange?: [number, number];
  series: Series[];
  /** Whether the values span powers of ten. */
  logarithmic?: boolean;
  /** Whether lines break where there is no value. */
  breaks?: boolean;
}

interface Props {
  curve: Curve;
  /** Draws a line here. */
  at?: number;
  /** Called with x where somebody clicks. */
  onPick?: (x: number) => void;
}

const HEIGHT = 150;

/** Whether there is one value, which a line would not show. */
export function isSingle(values: ArrayLike<unknown>): boolean {
  let found = 0;
  for (let i = 0; i < values.length && found < 2; ++i) {
    if (values[i] != null) ++found;
  }
  return found === 1;
}

function optionsOf(latest: () => Curve, width: number,
                   at: () => number|undefined): uPlot.Options {
  const curve = latest();
  const ink = colourOf('text');
  const axis = {
    stroke: ink,
    grid: {stroke: colourOf('grid'), width: 1},
    ticks: {stroke: colourOf('grid'), width: 1},
    font: '11px system-ui, sans-serif',
  };
  return {
    width,
    height: HEIGHT,
    scales: {
      x: {time: false, range: (_, low, high) => latest().xRange ?? [low, high]},
      y: curve.logarithmic ? {distr: 3} : {},
    },
    axes: [
      {...axis, size: 30},
      {...axis, size: 56,
       values: (_, ticks) => ticks.map(
           tick => tick === null ? '' : String(Number(tick.toPrecision(4))))},
    ],
    cursor: {sync: {key: 'curves'}, drag: {x: false, y: false}},
    legend: {live: false},
    series: [
      {label: curve.xLabel},
      ...curve.series.map(({label, colour, as}): uPlot.Series => ({
        label,
        stroke: colourOf(colour),
        width: as === 'points' ? 0 : 1.5,
        dash: as === 'dashes' ? [6, 4] : undefined,
        paths: as === 'points' ? () => null : undefined,
        points: {
          show: (plot, i) => as === 'points' || isSingle(plot.data[i]),
          size: 5, fill: colourOf(colour),
        },
        spanGaps: as !== 'points' && !curve.breaks,
      })),
    ],
    hooks: {
      draw: [plot => {
        const x = at();
        if (x === undefined) return;
        const {left, top, width: inner, height} = plot.bbox;
        const pixel = plot.valToPos(x, 'x', true);
        if (pixel < left || pixel > left + inner) return;
        plot.ctx.save();
        plot.ctx.strokeStyle = colourOf('selected');
        plot.ctx.lineWidth = devicePixelRatio;
        plot.ctx.setLineDash([]);
        plot.ctx.beginPath();
        plot.ctx.moveTo(pixel, top);
        plot.ctx.lineTo(pixel, top + height);
        plot.ctx.stroke();
        plot.ctx.restore();
      }],
    },
  };
}

function dataOf(curve: Curve): uPlot.AlignedData {
  return [curve.x, ...curve.series.map(({values}) => values)];
}

export function CurveView({curve, at, onPick}: Props) {
  const parent = useRef<HTMLDivElement>(null);
  const plot = useRef<uPlot>();
  const latest = useRef({curve, at, onPick});
  latest.current = {curve, at, onPick};
  useEffect(() => {
    const element = parent.current!;
    const make = () => {
      plot.current?.destroy();
      plot.current = new uPlot(
          optionsOf(() => latest.current.curve, element.clientWidth,
                    () => latest.current.at),
          dataOf(latest.current.curve), element);
      const {over} = plot.current;
      over.addEventListener('click', () => {
        const made = plot.current!;
        const x = made.posToVal(made.cursor.left ?? -1, 'x');
        if (Number.isFinite(x)) latest.current.onPick?.(x);
      });
    };
    const end = effect(() => {
      dark.value;
      make();
    });
    const sized = new ResizeObserver(() => plot.current!.setSize(
        {width: element.clientWidth, height: HEIGHT}));
    sized.observe(element);
    return () => {
      end();
      sized.disconnect();
      plot.current?.destroy();
    };
  }, []);
  useEffect(() => plot.current!.setData(dataOf(curve)), [curve]);
  useEffect(() => {
    // Without data there are no scales yet, and nothing to redraw.
    if (plot.current!.scales.x.min != null) plot.current!.redraw();
  }, [at]);
  return (
    <figure class="curve">
      <figcaption>{curve.title}</figcaption>
      <div ref={parent} />
    </figure>
  );
}
