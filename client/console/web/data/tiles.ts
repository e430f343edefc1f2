// The tiles of the base map that have been drawn, on the page's side.
import {signal} from '@preact/signals';

import {colourOf} from '../draw/scene.js';
import {GROUND_COLOURS, type Palette} from '../draw/tile_painter.js';
import {nameOf, type Tile, type Tiling} from '../geometry/tiles.js';
import {dark} from '../theme.js';
import type {TileMessage, TileRequest} from './tile_worker.js';

export interface Archive {
  tiling: Tiling;
  /** Pictures, whose colours are as they are in either theme. */
  isRaster: boolean;
  /** Text that has to be shown with the map; it may hold HTML. */
  attribution: string;
}

const AT_A_TIME = 6;
const MOST_TILES = 120;

export class TileStore {
  /** Undefined until its head was read. */
  readonly archive = signal<Archive|undefined>(undefined);
  readonly error = signal<string|undefined>(undefined);
  /** Changes when a tile has come. */
  readonly arrivals = signal(0);
  /** Null where the archive has none; those used last at the end. */
  private readonly tiles = new Map<string, ImageBitmap|null>();
  private readonly asking = new Set<string>();
  private wanted: Tile[] = [];
  /** Counts themes, since tiles of another are not wanted any more. */
  private generation = 0;
  private palette!: Palette;
  private readonly worker = new Worker(
      new URL('./tile_worker.ts', import.meta.url), {type: 'module'});

  constructor(url: string) {
    this.worker.onmessage = ({data}: MessageEvent<TileMessage>) =>
        this.receive(data);
    this.worker.onerror = event => {
      this.error.value = event.message;
    };
    dark.subscribe(() => this.changeTheme());
    this.send({kind: 'open', url});
  }

  /** The tile, or null if the archive has none; undefined if it is not here. */
  find(tile: Tile): ImageBitmap|null|undefined {
    return this.tiles.get(nameOf(tile));
  }

  /** Sees to these tiles, the most urgent first, and to no others any more. */
  want(tiles: readonly Tile[]): void {
    this.wanted = [...tiles];
    for (const name of tiles.map(nameOf)) {
      const bitmap = this.tiles.get(name);
      if (bitmap === undefined) continue;
      this.tiles.delete(name);
      this.tiles.set(name, bitmap);
    }
    this.proceed();
  }

  private proceed(): void {
    if (!this.archive.value) return;
    for (const tile of this.wanted) {
      if (this.asking.size >= AT_A_TIME) return;
      const name = nameOf(tile);
      if (this.tiles.has(name) || this.asking.has(name)) continue;
      this.asking.add(name);
      this.send({kind: 'draw', tile, palette: this.palette,
                 scale: devicePixelRatio > 1 ? 2 : 1,
                 generation: this.generation});
    }
  }

  private receive(message: TileMessage): void {
    if (message.kind === 'error') {
      this.error.value = message.message;
      return;
    }
    if (message.kind === 'archive') {
      this.archive.value = message;
    } else if (message.generation === this.generation) {
      const name = nameOf(message.tile);
      this.asking.delete(name);
      this.tiles.set(name, message.bitmap);
      if (this.tiles.size > MOST_TILES) {
        this.tiles.delete(this.tiles.keys().next().value!);
      }
      ++this.arrivals.value;
    }
    this.proceed();
  }

  private changeTheme(): void {
    this.palette = Object.fromEntries(GROUND_COLOURS.map(
        name => [name, colourOf(name)])) as Palette;
    if (this.archive.value?.isRaster) return;
    ++this.generation;
    this.asking.clear();
    this.tiles.clear();
    this.proceed();
    ++this.arrivals.value;
  }

  private send(request: TileRequest): void {
    this.worker.postMessage(request);
  }
}
