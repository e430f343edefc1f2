// What a map shows, whatever draws it: the screen, or a file.
import type {Box, View} from '../geometry/view.js';

/** Names of the custom properties in style.css that hold the colours. */
export type Colour =
    'path'|'path-ahead'|'ellipse'|'closure'|'rejection'|'vehicle'|'selected'|
    'stretch'|'accepted'|'rejected-by-gate'|'rejected-by-shape'|'ambiguous'|
    'uninformative'|'ill-conditioned'|'matched-path'|'query-path'|'text'|
    'background'|'grid'|'threshold'|'scale';

export interface Strokes {
  kind: 'strokes';
  id: string;
  label: string;
  colour: Colour;
  widthPixels: number;
  /** Segments x0, y0, x1, y1 in metres. The same array as long as they are the
   * same. */
  segmentsIn(view: View): Float32Array;
  /** Where a click on segment i leads. */
  link?: (segment: number) => string;
}

export interface Dots {
  kind: 'dots';
  id: string;
  label: string;
  colour: Colour;
  radiusPixels: number;
  /** x0, y0, x1, y1 in metres. */
  positions: Float32Array;
  link?: (dot: number) => string;
}

export type Shape = Strokes|Dots;

export interface Scene {
  /** From the undermost. */
  shapes: Shape[];
  /** What is to be seen at first; undefined if there is nothing. */
  box: Box|undefined;
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

/** The colour in use: it follows the theme. */
export function colourOf(name: Colour): string {
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
