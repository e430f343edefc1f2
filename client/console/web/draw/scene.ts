// The contents of a map, whatever draws it: the screen, or a file.
import type {Box, View} from '../geometry/view.js';
import type {GroundColour} from './tile_painter.js';

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

const REACH_PIXELS = 6;

/** Where a click at these pixels of a map leads: the link of the nearest thing
 * within reach, of those that are drawn last first. */
export function linkAt(scene: Scene, view: View, px: number, py: number):
    string|undefined {
  const x = view.x + (px - view.width / 2) * view.metersPerPixel;
  const y = view.y - (py - view.height / 2) * view.metersPerPixel;
  for (const shape of [...scene.shapes].reverse()) {
    if (!shape.link) continue;
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
    if (nearest >= 0) return shape.link(nearest);
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
