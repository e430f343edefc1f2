// Reads tiles of the base map and draws them, away from the page's own thread.
import {VectorTile} from '@mapbox/vector-tile';
import Pbf from 'pbf';
import {PMTiles, TileType} from 'pmtiles';

import {type Palette, paintTile, type Part} from '../draw/tile_painter.js';
import {nameOf, type Tile, type Tiling} from '../geometry/tiles.js';

export type TileRequest =
    {kind: 'open', url: string}|
    /** `generation` comes back with the answer. */
    {kind: 'draw', tile: Tile, palette: Palette, scale: number,
     generation: number};

export type TileMessage =
    {kind: 'archive', tiling: Tiling, isRaster: boolean, attribution: string}|
    /** Null where the archive has no such tile. */
    {kind: 'tile', tile: Tile, generation: number, bitmap: ImageBitmap|null}|
    {kind: 'error', message: string};

type Source = ImageBitmap|VectorTile;

/** Levels beyond the archive's last at which its tiles are still divided. */
const MOST_DEPTH = 6;
const MOST_SOURCES = 24;
const RASTER_PIXELS = 256;
/** On the screen; a tile is drawn so large that it is not magnified. */
const VECTOR_PIXELS = 360;
const VECTOR_SIDE = 512;
const RASTERS = [TileType.Png, TileType.Jpeg, TileType.Webp, TileType.Avif];

let archive: PMTiles;
let isRaster = false;
let lastLevel = 0;
/** The eldest first. */
const sources = new Map<string, Promise<Source|undefined>>();

function post(message: TileMessage, transfer: Transferable[] = []): void {
  (self as unknown as Worker).postMessage(message, transfer);
}

async function open(url: string): Promise<void> {
  archive = new PMTiles(url);
  const {tileType, minZoom, maxZoom} = await archive.getHeader();
  isRaster = RASTERS.includes(tileType);
  if (!isRaster && tileType !== TileType.Mvt) {
    throw new Error('its tiles are neither pictures nor MVT');
  }
  lastLevel = maxZoom;
  const {attribution} =
      (await archive.getMetadata() ?? {}) as {attribution?: unknown};
  post({
    kind: 'archive',
    tiling: {
      leastZoom: minZoom,
      mostZoom: maxZoom + MOST_DEPTH,
      sidePixels: isRaster ? RASTER_PIXELS : VECTOR_PIXELS,
    },
    isRaster,
    attribution: typeof attribution === 'string' ? attribution : '',
  });
}

async function read({z, x, y}: Tile): Promise<Source|undefined> {
  const found = await archive.getZxy(z, x, y);
  if (!found) return undefined;
  return isRaster ? createImageBitmap(new Blob([found.data])) :
                    new VectorTile(new Pbf(found.data));
}

/** The tile as it is in the archive, or as it was read lately. */
function sourceOf(tile: Tile): Promise<Source|undefined> {
  const name = nameOf(tile);
  const source = sources.get(name) ?? read(tile);
  sources.delete(name);
  sources.set(name, source);
  source.catch(() => sources.delete(name));
  if (sources.size > MOST_SOURCES) sources.delete(sources.keys().next().value!);
  return source;
}

async function draw({z, x, y}: Tile, palette: Palette, scale: number):
    Promise<ImageBitmap|null> {
  const depth = Math.max(0, z - lastLevel);
  const parts = 2 ** depth;
  const part: Part = {depth, column: x % parts, row: y % parts};
  const source = await sourceOf(
      {z: z - depth, x: Math.floor(x / parts), y: Math.floor(y / parts)});
  if (!source) return null;
  if (source instanceof VectorTile) {
    const side = VECTOR_SIDE * scale;
    const canvas = new OffscreenCanvas(side, side);
    paintTile(source, part, z, palette, canvas.getContext('2d')!);
    return canvas.transferToImageBitmap();
  }
  const [width, height] = [source.width / parts, source.height / parts];
  return createImageBitmap(
      source, part.column * width, part.row * height, width, height,
      {resizeWidth: source.width, resizeHeight: source.height});
}

async function answer(request: TileRequest): Promise<void> {
  if (request.kind === 'open') {
    await open(request.url);
    return;
  }
  const {tile, palette, scale, generation} = request;
  let bitmap: ImageBitmap|null = null;
  try {
    bitmap = await draw(tile, palette, scale);
  } finally {
    post({kind: 'tile', tile, generation, bitmap}, bitmap ? [bitmap] : []);
  }
}

self.onmessage = ({data}: MessageEvent<TileRequest>) => {
  answer(data).catch((error: Error) => {
    post({kind: 'error', message: error.message});
  });
};
