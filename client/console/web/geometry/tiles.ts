// The tiles of a base map that a view needs. Tiles are those of web maps: level
// z divides Mercator's square map of the earth into 2^z by 2^z of them, counted
// from its northern and western edges.
import {type Frame, mercatorHeight, type Place, toEarth} from './frame.js';
import {boxOf, type View} from './view.js';

export interface Tile {
  z: number;
  x: number;
  y: number;
}

/** Which tiles there are, and how large they should look. */
export interface Tiling {
  leastZoom: number;
  mostZoom: number;
  /** Pixels of the screen that the side of a tile takes, about. */
  sidePixels: number;
}

/** Corners of a tile on the map, in metres: south-west, north-west, north-east,
 * south-east. */
export type Corners = Array<[number, number]>;

const MOST_TILES = 80;
/** Nothing is drawn farther from the origin of the frame: neither of its kinds
 * shows more of the earth as it is. */
const REACH_METERS = 500_000;
const EARTH_METERS = 2 * Math.PI * 6378137;

export function nameOf({z, x, y}: Tile): string {
  return `${z}/${x}/${y}`;
}

/** Column and row of a place at a level, with the part of the tile. */
function inTiles({latitude, longitude}: Place, z: number): [number, number] {
  return [
    2 ** z * (longitude + 180) / 360,
    2 ** z * (1 - mercatorHeight(latitude) / Math.PI) / 2,
  ];
}

function placeOf(x: number, y: number, z: number): Place {
  const height = Math.PI * (1 - 2 * y / 2 ** z);
  return {
    latitude: Math.atan(Math.sinh(height)) * 180 / Math.PI,
    longitude: 360 * x / 2 ** z - 180,
  };
}

export function cornersOf({z, x, y}: Tile, frame: Frame): Corners {
  return [[x, y + 1], [x, y], [x + 1, y], [x + 1, y + 1]].map(
      ([column, row]) => frame.toMap(placeOf(column, row, z)));
}

/** The tile one level up that holds this one; undefined for the whole earth. */
export function parentOf({z, x, y}: Tile): Tile|undefined {
  return z === 0 ? undefined : {z: z - 1, x: x >> 1, y: y >> 1};
}

function levelFor(view: View, {origin}: Frame, tiling: Tiling): number {
  const around = EARTH_METERS * Math.cos(origin.latitude * Math.PI / 180);
  const level = Math.round(
      Math.log2(around / (view.metersPerPixel * tiling.sidePixels)));
  return Math.max(tiling.leastZoom, Math.min(tiling.mostZoom, level));
}

/** The tiles that cover a view, those in its middle first; none where they
 * would be too many. */
export function tilesIn(view: View, frame: Frame, tiling: Tiling): Tile[] {
  const box = boxOf(view);
  const bounded = (value: number) =>
      Math.max(-REACH_METERS, Math.min(REACH_METERS, value));
  const [left, right] = [bounded(box.left), bounded(box.right)];
  const [bottom, top] = [bounded(box.bottom), bounded(box.top)];
  if (left >= right || bottom >= top) return [];
  const z = levelFor(view, frame, tiling);
  const middleX = (left + right) / 2;
  // North is not quite up away from the origin, so edges count, not corners
  // alone.
  const edge = [[left, bottom], [left, top], [right, bottom], [right, top],
                [middleX, bottom], [middleX, top]]
                   .map(([x, y]) => inTiles(toEarth(frame, x, y), z));
  const columns = edge.map(([column]) => column);
  const rows = edge.map(([, row]) => row);
  const [firstX, lastX] = [Math.floor(Math.min(...columns)),
                           Math.floor(Math.max(...columns))];
  const [firstY, lastY] = [Math.max(0, Math.floor(Math.min(...rows))),
                           Math.min(2 ** z - 1, Math.floor(Math.max(...rows)))];
  if ((lastX - firstX + 1) * (lastY - firstY + 1) > MOST_TILES) return [];
  const tiles: Tile[] = [];
  for (let y = firstY; y <= lastY; ++y) {
    for (let x = Math.max(0, firstX); x <= Math.min(2 ** z - 1, lastX); ++x) {
      tiles.push({z, x, y});
    }
  }
  const [cx, cy] = [(firstX + lastX) / 2, (firstY + lastY) / 2];
  const far = ({x, y}: Tile) => Math.hypot(x - cx, y - cy);
  return tiles.sort((a, b) => far(a) - far(b));
}
