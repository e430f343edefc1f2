// The contents of a map, whatever draws it: the screen, or a file.
import type {Box, View} from '../geometry/view.js';
import type {GroundColour} from './tile_painter.js';

/** Names of the custom properties in style.css that hold the colours. */
export type Colour =
    'path'|'path-ahead'|'ellipse'|'closure'|'rejection'|'vehicle'|'selected'|
    'stretch'|'accepted'|'rejected-by-gate'|'rejected-by-shape'|'ambiguous'|
    'uninformative'|'ill-conditioned'|'matched-path'|'query-path'|'text'|
    'background'|'grid'|'threshold'|'scale'|RecordingColour;

/** Colours of the recordings before a vehicle's last one. */
export const RECORDING_COLOURS = ['recording-1', 'recording-2', 'recording-3',
                                  'recording-4'] as const;
type RecordingColour = typeof RECORDING_COLOURS[number];

/** The things that the segments or dots of a shape stand for, by their
 * number. */
export interface Things {
  /** Where a click leads. */
  link: (i: number) => string;
  /** Text that is shown where somebody points at it. */
  tip: (i: number) => string;
  /** The key of its row in the table beside the map. */
  key: (i: number) => string;
}

/** One of the things of a shape. */
export interface Hit {
  link: string;
  tip: string;
  key: string;
}

export interface Strokes {
  kind: 'strokes';
  id: string;
  label: string;
  colour: Colour;
  widthPixels: number;
  /** Segments x0, y0, x1, y1 in metres. The same array as long as they are the
   * same. */
  segmentsIn(view: View): Float32Array;
  /** Pixels that are drawn and left out in turn; undefined for all. */
  dash?: [number, number];
  things?: Things;
}

export interface Dots {
  kind: 'dots';
  id: string;
  label: string;
  colour: Colour;
  radiusPixels: number;
  /** x0, y0, x1, y1 in metres. */
  positions: Float32Array;
  things?: Things;
}

export type Shape = Strokes|Dots;

export interface Scene {
  /** From the undermost. */
  shapes: Shape[];
  /** The part that is to be seen at first; undefined if there is nothing. */
  box: Box|undefined;
  /** Names of places, the most important first. */
  names?: PlaceName[];
}

/** Text at a place in metres. */
export interface PlaceName {
  text: string;
  colour: Colour;
  x: number;
  y: number;
}

/** A name at its place on the screen, in pixels. */
export interface ShownName {
  text: string;
  colour: Colour;
  left: number;
  top: number;
  /** Whether the text is left of its place, since it would not fit right of it. */
  isBefore: boolean;
}

const MOST_NAMES = 40;
const MOST_LETTERS = 28;
const LETTER_PIXELS = 7;
/** Beside the letters: the gap and the swatch. */
const NAME_EXTRA_PIXELS = 48;
const NAME_HEIGHT = 20;

/** The names in view, without those that would lie over one before them. */
export function namesIn({names = []}: Scene, view: View): ShownName[] {
  const shown: Array<ShownName & {from: number, to: number}> = [];
  for (const {text, colour, x, y} of names) {
    if (shown.length === MOST_NAMES) break;
    const left = view.width / 2 + (x - view.x) / view.metersPerPixel;
    const top = view.height / 2 - (y - view.y) / view.metersPerPixel;
    if (left < 0 || top < 0 || left > view.width || top > view.height) continue;
    const cut = text.length > MOST_LETTERS ?
        `${text.slice(0, MOST_LETTERS - 1)}…` : text;
    const width = LETTER_PIXELS * cut.length + NAME_EXTRA_PIXELS;
    const isBefore = left + width > view.width && left > width;
    const [from, to] = isBefore ? [left - width, left] : [left, left + width];
    const isFree = shown.every(
        other => from > other.to || to < other.from ||
            Math.abs(top - other.top) >= NAME_HEIGHT);
    if (isFree) shown.push({text: cut, colour, left, top, isBefore, from, to});
  }
  return shown;
}

export function strokes(shape: Omit<Strokes, 'kind'|'segmentsIn'>,
                        segments: ArrayLike<number>): Strokes {
  const array = Float32Array.from(segments);
  return {...shape, kind: 'strokes', segmentsIn: () => array};
}

export function dots(shape: Omit<Dots, 'kind'|'positions'>,
                     positions: ArrayLike<number>): Dots {
  return {...shape, kind: 'dots', positions: Float32Array.from(positions)};
}

/** Corners x0, y0, x1, y1, ... of marks, in a square from -1 to 1; each stroke
 * leads from one corner to the next. */
const MARKS = {
  triangle: [0, 1, 0.95, -0.7, -0.95, -0.7, 0, 1],
  square: [-0.8, -0.8, 0.8, -0.8, 0.8, 0.8, -0.8, 0.8, -0.8, -0.8],
  diamond: [0, 1, 1, 0, 0, -1, -1, 0, 0, 1],
  circle: Array.from({length: 13}, (_, i) => [
    Math.cos(i * Math.PI / 6), Math.sin(i * Math.PI / 6)]).flat(),
  cross: [-0.8, -0.8, 0.8, 0.8, 0, 0, -0.8, 0.8, 0.8, -0.8],
  bar: [0, -1, 0, 1],
};
export type Mark = keyof typeof MARKS;
const MARK_PIXELS = 5;

/** Marks of one size on the screen at points x0, y0, x1, y1, ... in metres. */
export function marks(shape: Omit<Strokes, 'kind'|'segmentsIn'>, mark: Mark,
                      points: ArrayLike<number>): Strokes {
  const corners = MARKS[mark];
  const all = new Float32Array(points.length / 2 * (2 * corners.length - 4));
  let [drawn, segments] = [NaN, all];
  const draw = (size: number) => {
    segments = new Float32Array(all.length);
    let at = 0;
    for (let i = 0; i < points.length; i += 2) {
      for (let k = 0; k + 2 < corners.length; k += 2) {
        for (let end = 0; end < 4; ++end) {
          segments[at++] = points[i + end % 2] + size * corners[k + end];
        }
      }
    }
  };
  return {
    ...shape,
    kind: 'strokes',
    segmentsIn: ({metersPerPixel}) => {
      if (metersPerPixel !== drawn) draw(MARK_PIXELS * metersPerPixel);
      drawn = metersPerPixel;
      return segments;
    },
  };
}

const SELECTED_PIXELS = 3;

/** The things with a key, drawn once more so that they stand out. */
export function selectedIn({shapes}: Scene, view: View, key: string|undefined):
    Shape[] {
  if (key === undefined) return [];
  return shapes.flatMap((shape): Shape[] => {
    const {things} = shape;
    if (!things) return [];
    const numbers = shape.kind === 'dots' ? shape.positions :
                                            shape.segmentsIn(view);
    const size = shape.kind === 'dots' ? 2 : 4;
    const chosen: number[] = [];
    for (let i = 0; i < numbers.length; i += size) {
      if (things.key(i / size) !== key) continue;
      chosen.push(...numbers.subarray(i, i + size));
    }
    if (chosen.length === 0) return [];
    const drawn = {id: `selected ${shape.id}`, label: 'Selected',
                   colour: 'selected' as const};
    return [shape.kind === 'dots' ?
      dots({...drawn, radiusPixels: shape.radiusPixels + SELECTED_PIXELS},
           chosen) :
      strokes({...drawn, widthPixels: shape.widthPixels + SELECTED_PIXELS},
              chosen)];
  });
}

const REACH_PIXELS = 6;

/** Finds what lies at these pixels of a map: the nearest thing within reach, of
 * those that are drawn last first. */
export function hitAt(scene: Scene, view: View, px: number, py: number):
    Hit|undefined {
  const x = view.x + (px - view.width / 2) * view.metersPerPixel;
  const y = view.y - (py - view.height / 2) * view.metersPerPixel;
  for (const shape of [...scene.shapes].reverse()) {
    const {things} = shape;
    if (!things) continue;
    const numbers = shape.kind === 'dots' ? shape.positions :
                                            shape.segmentsIn(view);
    const size = shape.kind === 'dots' ? 2 : 4;
    let nearest = -1;
    let least = REACH_PIXELS * view.metersPerPixel;
    for (let i = 0; i < numbers.length; i += size) {
      const [x0, y0] = [numbers[i], numbers[i + 1]];
      const [dx, dy] = [numbers[i + size - 2] - x0, numbers[i + size - 1] - y0];
      const square = dx * dx + dy * dy;
      const along = square === 0 ? 0 : Math.min(1, Math.max(
          0, ((x - x0) * dx + (y - y0) * dy) / square));
      const distance = Math.hypot(x0 + along * dx - x, y0 + along * dy - y);
      if (distance <= least) {
        least = distance;
        nearest = i / size;
      }
    }
    if (nearest >= 0) {
      return {link: things.link(nearest), tip: things.tip(nearest),
              key: things.key(nearest)};
    }
  }
  return undefined;
}

/** The colour in use: it follows the theme. */
export function colourOf(name: Colour|GroundColour): string {
  return getComputedStyle(document.documentElement)
      .getPropertyValue(`--${name}`)
      .trim();
}

/** A colour #rrggbb as three numbers. */
export function components(colour: string): [number, number, number] {
  const value = parseInt(colour.slice(1), 16);
  return [value >> 16, (value >> 8) & 255, value & 255];
}

/** A round length for the scale bar that takes at most so many pixels. */
export function scaleBarMeters(metersPerPixel: number, mostPixels: number):
    number {
  const most = metersPerPixel * mostPixels;
  const decade = 10 ** Math.floor(Math.log10(most));
  return decade * (most >= 5 * decade ? 5 : most >= 2 * decade ? 2 : 1);
}
