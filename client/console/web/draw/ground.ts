// The base map below a map of paths. Loaded only where there is one.
import type {Layer} from '@deck.gl/core';
import {BitmapLayer} from '@deck.gl/layers';

import {type Archive, TileStore} from '../data/tiles.js';
import type {Frame} from '../geometry/frame.js';
import {type Corners, cornersOf, nameOf, parentOf, type Tile, tilesIn} from
    '../geometry/tiles.js';
import type {View} from '../geometry/view.js';
import {dark} from '../theme.js';

/** How much of a picture's brightness is left on a dark page. */
const DARK_OPACITY = 0.55;
/** deck.gl blends by the root of this degree of a layer's opacity. */
const DECK_GAMMA = 2.2;
/** Pixels of a saved picture for one of the screen. */
const PICTURE_SCALE = 2;

interface Placed {
  tile: Tile;
  bitmap: ImageBitmap;
  corners: Corners;
}

let shared: TileStore|undefined;

/** The tiles of the console's base map, which all maps share. */
export function tileStore(): TileStore {
  shared ??= new TileStore(new URL('/base-map.pmtiles', location.href).href);
  return shared;
}

function opacityOf({isRaster}: Archive): number {
  return isRaster && dark.value ? DARK_OPACITY : 1;
}

/** The base map in one frame. */
export class Ground {
  private readonly corners = new Map<string, Corners>();

  constructor(private readonly store: TileStore,
              private readonly frame: Frame) {}

  /** Draws the tiles of a view that are here, and asks for those that are
   * not. */
  layersIn(view: View): Layer[] {
    const archive = this.store.archive.value;
    if (!archive) return [];
    return this.placedIn(view, archive).map(
        ({tile, bitmap, corners}) => new BitmapLayer({
          id: `ground ${nameOf(tile)}`,
          image: bitmap,
          bounds: corners as [[number, number], [number, number],
                              [number, number], [number, number]],
          opacity: opacityOf(archive) ** DECK_GAMMA,
          parameters: {depthWriteEnabled: false, depthCompare: 'always'},
        }));
  }

  /** The base map of a view as the address of a picture with its data. */
  async picture(view: View): Promise<string|undefined> {
    const archive = this.store.archive.value;
    if (!archive) return undefined;
    const canvas = new OffscreenCanvas(PICTURE_SCALE * view.width,
                                       PICTURE_SCALE * view.height);
    const context = canvas.getContext('2d')!;
    const pixels = PICTURE_SCALE / view.metersPerPixel;
    const px = (x: number) => canvas.width / 2 + (x - view.x) * pixels;
    const py = (y: number) => canvas.height / 2 - (y - view.y) * pixels;
    for (const {bitmap, corners} of this.placedIn(view, archive)) {
      const [southWest, northWest, northEast] =
          corners.map(([x, y]) => [px(x), py(y)]);
      const [across, down] = [northEast, southWest].map(
          ([x, y]) => [x - northWest[0], y - northWest[1]]);
      context.setTransform(across[0], across[1], down[0], down[1],
                           ...northWest as [number, number]);
      // Tiles overlap by a pixel, so that nothing shines through between them.
      const [wide, high] =
          [across, down].map(([x, y]) => 1 + 1 / Math.hypot(x, y));
      context.drawImage(bitmap, 0, 0, wide, high);
    }
    context.resetTransform();
    context.globalCompositeOperation = 'destination-in';
    context.globalAlpha = opacityOf(archive);
    context.fillRect(0, 0, canvas.width, canvas.height);
    const blob = await canvas.convertToBlob({type: 'image/png'});
    return new Promise((resolve, reject) => {
      const reader = new FileReader();
      reader.onload = () => resolve(reader.result as string);
      reader.onerror = () => reject(reader.error as Error);
      reader.readAsDataURL(blob);
    });
  }

  /** Tiles of a view, above coarser ones where those are still to come. */
  private placedIn(view: View, {tiling}: Archive): Placed[] {
    const tiles = tilesIn(view, this.frame, tiling);
    this.store.want(tiles);
    const drawn = new Map<string, Placed>();
    for (const tile of tiles) {
      for (let found: Tile|undefined = tile; found; found = parentOf(found)) {
        const bitmap = this.store.find(found);
        if (bitmap === undefined) continue;
        if (bitmap) {
          drawn.set(nameOf(found), {tile: found, bitmap,
                                    corners: this.cornersOf(found)});
        }
        break;
      }
    }
    return [...drawn.values()].sort((a, b) => a.tile.z - b.tile.z);
  }

  // deck.gl compares the corners of a layer by identity.
  private cornersOf(tile: Tile): Corners {
    const name = nameOf(tile);
    let corners = this.corners.get(name);
    if (!corners) {
      corners = cornersOf(tile, this.frame);
      this.corners.set(name, corners);
    }
    return corners;
  }
}
