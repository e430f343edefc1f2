// Lines of latitude and longitude, for maps whose place on the earth is known.
import {type Frame, type Place, toEarth} from '../geometry/frame.js';
import {boxOf, type View} from '../geometry/view.js';
import type {Strokes} from './scene.js';

/** Degrees between two lines that are more than one apart. */
const WIDE_STEPS = [2, 5, 10, 15, 30, 45, 90];
const LEAST_PIXELS = 110;
const PIECES = 16;
const MOST_LINES = 60;

/** A line's number of degrees, where it enters the view. */
export interface LineLabel {
  text: string;
  /** Pixels from the left upper corner of the map. */
  left: number;
  top: number;
}

interface Lines {
  segments: Float32Array;
  labels: LineLabel[];
}

const NOTHING: Lines = {segments: new Float32Array(0), labels: []};

function stepFor(degreesPerPixel: number): number {
  const least = LEAST_PIXELS * degreesPerPixel;
  if (least > 1) return WIDE_STEPS.find(step => step >= least) ?? 90;
  const decade = 10 ** Math.floor(Math.log10(least));
  return decade * (least <= decade ? 1 : least <= 2 * decade ? 2 : least <= 5 * decade ? 5 : 10);
}

/** Degrees with as many digits as lines that are `step` apart need. */
function degreesText(degrees: number, step: number, [positive, negative]:
    [string, string]): string {
  const digits = Math.max(0, Math.ceil(-Math.log10(step) - 1e-9));
  return `${Math.abs(degrees).toFixed(digits)}° ${
      degrees < 0 ? negative : positive}`;
}

/** A place as people read it. */
export function placeText({latitude, longitude}: Place, step = 1e-5): string {
  const turned = ((longitude + 180) % 360 + 360) % 360 - 180;
  return `${degreesText(latitude, step, ['N', 'S'])}, ${
      degreesText(turned, step, ['E', 'W'])}`;
}

function linesIn(view: View, frame: Frame): Lines {
  const box = boxOf(view);
  const corners = [[box.left, box.bottom], [box.left, box.top],
                   [box.right, box.bottom], [box.right, box.top]]
      .map(([x, y]) => toEarth(frame, x, y));
  const latitudes = corners.map(({latitude}) => latitude);
  const longitudes = corners.map(({longitude}) => longitude);
  const [south, north] = [Math.min(...latitudes), Math.max(...latitudes)];
  const [west, east] = [Math.min(...longitudes), Math.max(...longitudes)];
  const step = Math.max(stepFor((north - south) / view.height),
                        stepFor((east - west) / view.width));
  if (!(step > 0) || (north - south + east - west) / step > MOST_LINES) {
    return NOTHING;
  }
  const numbers: number[] = [];
  const labels: LineLabel[] = [];
  const pixel = ([x, y]: [number, number]) => [
    view.width / 2 + (x - view.x) / view.metersPerPixel,
    view.height / 2 - (y - view.y) / view.metersPerPixel];
  const line = (placeAt: (part: number) => Place) => {
    const points = Array.from({length: PIECES + 1},
                              (_, i) => frame.toMap(placeAt(i / PIECES)));
    points.slice(1).forEach(
        (point, i) => numbers.push(...points[i], ...point));
    return points;
  };
  const multiples = (from: number, to: number) => Array.from(
      {length: Math.max(0, Math.floor(to / step) - Math.ceil(from / step) + 1)},
      (_, i) => (Math.ceil(from / step) + i) * step);
  for (const latitude of multiples(south, north)) {
    const [first] = line(part => (
        {latitude, longitude: west + part * (east - west)}));
    labels.push({text: degreesText(latitude, step, ['N', 'S']), left: 4,
                 top: pixel(first)[1]});
  }
  for (const longitude of multiples(west, east)) {
    const points = line(part => (
        {latitude: south + part * (north - south), longitude}));
    labels.push({text: degreesText(longitude, step, ['E', 'W']),
                 left: pixel(points[PIECES])[0], top: 4});
  }
  return {segments: Float32Array.from(numbers), labels: labels.filter(
      ({left, top}) => left >= 0 && top >= 0 && left < view.width - 60 &&
          top < view.height - 40)};
}

/** The lines of one frame. */
export class Graticule {
  readonly shape: Strokes;
  private drawn = '';
  private lines = NOTHING;

  constructor(private readonly frame: Frame) {
    this.shape = {
      kind: 'strokes', id: 'graticule', label: 'Latitude and longitude',
      colour: 'grid', widthPixels: 1,
      segmentsIn: view => this.in(view).segments,
    };
  }

  labelsIn(view: View): LineLabel[] {
    return this.in(view).labels;
  }

  private in(view: View): Lines {
    const drawn = [view.x, view.y, view.metersPerPixel, view.width,
                   view.height].join();
    if (drawn !== this.drawn) {
      this.drawn = drawn;
      this.lines = linesIn(view, this.frame);
    }
    return this.lines;
  }
}
