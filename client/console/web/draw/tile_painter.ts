// Draws vector tiles (MVT) in a few muted colours, so that paths stand out.
// Layers are known by the names of three common schemas: Protomaps,
// OpenMapTiles and Shortbread. Others, and all labels, are left out.
import type {VectorTile, VectorTileFeature} from '@mapbox/vector-tile';

/** Names of the custom properties in style.css that hold the colours. */
export const GROUND_COLOURS = [
  'ground-land', 'ground-green', 'ground-built', 'ground-water',
  'ground-building', 'ground-road', 'ground-major-road', 'ground-boundary',
] as const;
export type GroundColour = typeof GROUND_COLOURS[number];
export type Palette = Record<GroundColour, string>;

/** Which part of a tile is drawn: all of it at 0, a quarter at 1, and so on. */
export interface Part {
  /** Levels that the part lies below its tile. */
  depth: number;
  /** Its column and row among the 2^depth of the tile. */
  column: number;
  row: number;
}

interface Rule {
  layers: string[];
  colour: GroundColour;
  kind: 'area'|'line';
  /** Pixels, at level 14, of a tile with a side of 512. */
  width?: number;
  takes?: (kind: string) => boolean;
}

const LAND_USE = ['landcover', 'landuse', 'park', 'land', 'sites'];
const ROADS = ['roads', 'transportation', 'streets'];
const GREEN = new Set([
  'allotments', 'cemetery', 'forest', 'garden', 'golf_course', 'grass',
  'grassland', 'meadow', 'national_park', 'nature_reserve', 'orchard', 'park',
  'pitch', 'playground', 'protected_area', 'recreation_ground', 'scrub',
  'village_green', 'vineyard', 'wetland', 'wood', 'zoo',
]);
const BUILT = new Set(['commercial', 'industrial', 'railway', 'residential',
                       'retail', 'urban_area']);
const MAJOR = new Set(['highway', 'major_road', 'motorway', 'primary',
                       'secondary', 'trunk']);
const THIN = new Set(['cycleway', 'footway', 'path', 'pedestrian', 'rail',
                      'steps', 'track', 'transit']);
const NOT_ROADS = new Set(['aerialway', 'ferry', 'pier']);

/** From the undermost. */
const RULES: Rule[] = [
  {layers: LAND_USE, colour: 'ground-built', kind: 'area',
   takes: kind => BUILT.has(kind)},
  {layers: LAND_USE, colour: 'ground-green', kind: 'area',
   takes: kind => GREEN.has(kind)},
  {layers: ['water', 'ocean', 'water_polygons'], colour: 'ground-water',
   kind: 'area'},
  {layers: ['water', 'waterway', 'water_lines'], colour: 'ground-water',
   kind: 'line', width: 1.5},
  {layers: ['buildings', 'building'], colour: 'ground-building', kind: 'area'},
  {layers: ROADS, colour: 'ground-road', kind: 'line', width: 0.8,
   takes: kind => THIN.has(kind)},
  {layers: ROADS, colour: 'ground-road', kind: 'line', width: 1.8,
   takes: kind => !MAJOR.has(kind) && !THIN.has(kind) && !NOT_ROADS.has(kind)},
  {layers: ROADS, colour: 'ground-major-road', kind: 'line', width: 3,
   takes: kind => MAJOR.has(kind)},
  {layers: ['boundaries', 'boundary'], colour: 'ground-boundary', kind: 'line',
   width: 0.8},
];

// Kinds of geometry, by the numbers that the vector-tile library gives them.
const LINE = 2;
const AREA = 3;
const WIDTH_LEVEL = 14;
const GROWTH = 1.4;

function kindOf({properties}: VectorTileFeature): string {
  const {kind, class: kindOfClass} = properties;
  return String(kind ?? kindOfClass ?? properties['pmap:kind'] ?? '');
}

function addTo(path: Path2D, feature: VectorTileFeature, scale: number,
               left: number, top: number): void {
  for (const ring of feature.loadGeometry()) {
    ring.forEach(({x, y}, i) => {
      const [px, py] = [scale * x - left, scale * y - top];
      if (i === 0) {
        path.moveTo(px, py);
      } else {
        path.lineTo(px, py);
      }
    });
    if (feature.type === AREA) path.closePath();
  }
}

/** Draws a part of a tile into a square canvas; `level` is that of the part. */
export function paintTile(tile: VectorTile, {depth, column, row}: Part,
                          level: number, palette: Palette,
                          context: OffscreenCanvasRenderingContext2D): void {
  const side = context.canvas.width;
  context.fillStyle = palette['ground-land'];
  context.fillRect(0, 0, side, side);
  context.lineCap = context.lineJoin = 'round';
  for (const {layers, colour, kind, width = 1, takes} of RULES) {
    const path = new Path2D();
    for (const layer of layers.map(name => tile.layers[name])) {
      if (!layer) continue;
      const scale = side * 2 ** depth / layer.extent;
      for (let i = 0; i < layer.length; ++i) {
        const feature = layer.feature(i);
        if (feature.type !== (kind === 'area' ? AREA : LINE) ||
            (takes && !takes(kindOf(feature)))) {
          continue;
        }
        addTo(path, feature, scale, side * column, side * row);
      }
    }
    if (kind === 'area') {
      context.fillStyle = palette[colour];
      context.fill(path);
    } else {
      context.strokeStyle = palette[colour];
      context.lineWidth = side / 512 * width *
          Math.max(0.3, GROWTH ** (level - WIDTH_LEVEL));
      context.stroke(path);
    }
  }
}
