import {Deck, type Layer, OrthographicView} from '@deck.gl/core';
import {ScatterplotLayer} from '@deck.gl/layers';
import {effect} from '@preact/signals';
import {useEffect, useMemo, useRef, useState} from 'preact/hooks';

import {consoleSettings} from '../data/console.js';
import {type Frame, toEarth} from '../geometry/frame.js';
import {type View, viewOf} from '../geometry/view.js';
import {Attribution, attributionText} from '../parts/attribution.js';
import {fixed, length} from '../parts/format.js';
import {go, query, setQuery} from '../route.js';
import {dark} from '../theme.js';
import {Graticule, placeText} from './graticule.js';
import type {Ground} from './ground.js';
import {colourOf, components, type Hit, hitAt, namesIn, scaleBarMeters,
        type Scene, selectedIn, type Shape} from './scene.js';
import {StrokeLayer} from './stroke_layer.js';
import type {MapSheet} from './svg.js';

interface DeckView {
  target: [number, number, number];
  zoom: number;
}

// deck.gl compares data by identity, so each array has one object for ever.
const dataOf = new WeakMap<Float32Array, object>();

function dotData(positions: Float32Array): object {
  let data = dataOf.get(positions);
  if (!data) {
    data = {
      length: positions.length / 2,
      attributes: {getPosition: {value: positions, size: 2}},
    };
    dataOf.set(positions, data);
  }
  return data;
}

function layerOf(shape: Shape, view: View): Layer {
  const colour = components(colourOf(shape.colour));
  return shape.kind === 'strokes' ?
      new StrokeLayer({
        id: shape.id,
        segments: shape.segmentsIn(view),
        colour: colour.map(part => part / 255) as [number, number, number],
        widthPixels: shape.widthPixels,
        dashPixels: shape.dash ?? [1, 0],
        view,
      }) :
      new ScatterplotLayer({
        id: shape.id,
        data: dotData(shape.positions) as never,
        getFillColor: colour,
        getRadius: shape.radiusPixels,
        radiusUnits: 'pixels',
        updateTriggers: {getFillColor: [colour.join()],
                         getRadius: [shape.radiusPixels]},
      });
}

/** Owns the canvas and what is drawn in it. */
class MapDrawing {
  private readonly deck: Deck<OrthographicView>;
  private scene: Scene = {shapes: [], box: undefined};
  private ground: Ground|undefined;
  private graticule: Graticule|undefined;
  private selected: string|undefined;
  private view: DeckView = {target: [0, 0, 0], zoom: 0};
  private width = 0;
  private height = 0;
  /** Once somebody has moved the map it stays where it is. */
  private moved = false;
  private fitted = '';
  /** The thing that the pointer is at. */
  private hit: Hit|undefined;

  constructor(parent: HTMLDivElement,
              private readonly onView: (view: View) => void,
              private readonly onPointer: (at: Pointer|undefined) => void) {
    this.deck = new Deck({
      parent,
      // The layers smooth their own edges, which costs software renderers less.
      deviceProps: {type: 'webgl', webgl: {antialias: false}},
      views: new OrthographicView({id: 'map', flipY: false}),
      controller: {keyboard: true, inertia: true},
      viewState: this.view,
      getCursor: ({isDragging}) =>
          isDragging ? 'grabbing' : this.hit ? 'pointer' : 'grab',
      onResize: ({width, height}) => {
        this.width = width;
        this.height = height;
        this.fit();
      },
      onViewStateChange: ({viewState}) => {
        this.moved = true;
        this.look(viewState as unknown as DeckView);
      },
      onHover: ({x, y}) => {
        // deck.gl tells of a pointer that leaves by a place outside.
        const isInside = x >= 0 && y >= 0 && x < this.width && y < this.height;
        this.hit = isInside ? hitAt(this.scene, this.current(), x, y) :
                              undefined;
        const view = this.current();
        this.onPointer(isInside ? {
          left: x, top: y, hit: this.hit,
          x: view.x + (x - view.width / 2) * view.metersPerPixel,
          y: view.y - (y - view.height / 2) * view.metersPerPixel,
        } : undefined);
      },
      onClick: ({x, y}) => {
        const hit = hitAt(this.scene, this.current(), x, y);
        if (hit) go(hit.link);
      },
    });
  }

  close(): void {
    this.deck.finalize();
  }

  show(scene: Scene): void {
    this.scene = scene;
    if (this.moved) {
      this.draw();
    } else {
      this.fit();
    }
  }

  /** Draws a base map below the scene, or none. */
  showGround(ground: Ground|undefined): void {
    this.ground = ground;
    this.draw();
  }

  /** Draws lines of latitude and longitude below the scene, or none. */
  showGraticule(graticule: Graticule|undefined): void {
    this.graticule = graticule;
    this.draw();
  }

  /** Makes the things with this key stand out. */
  select(key: string|undefined): void {
    this.selected = key;
    this.draw();
  }

  /** Shows all of the scene. */
  fitAgain(): void {
    this.moved = false;
    this.fitted = '';
    this.fit();
  }

  current(): View {
    return {
      x: this.view.target[0],
      y: this.view.target[1],
      metersPerPixel: 2 ** -this.view.zoom,
      width: this.width,
      height: this.height,
    };
  }

  draw(): void {
    if (this.width === 0) return;
    const view = this.current();
    this.deck.setProps({
      viewState: this.view,
      layers: [
        ...this.ground?.layersIn(view) ?? [],
        ...[
          ...this.graticule ? [this.graticule.shape] : [],
          ...this.scene.shapes,
          ...selectedIn(this.scene, view, this.selected),
        ].map(shape => layerOf(shape, view)),
      ],
    } as never);
    this.onView(view);
  }

  private fit(): void {
    const {box} = this.scene;
    const fitted = JSON.stringify([box, this.width, this.height]);
    if (this.moved || !box || this.width === 0 || fitted === this.fitted) {
      this.draw();
      return;
    }
    this.fitted = fitted;
    const view = viewOf(box, this.width, this.height);
    this.look({target: [view.x, view.y, 0],
               zoom: -Math.log2(view.metersPerPixel)});
  }

  private look(view: DeckView): void {
    this.view = view;
    this.draw();
  }
}

/** The base map in a frame, once its head was read. */
interface BaseMap {
  ground: Ground;
  /** Text that has to be shown with it; it may hold HTML. */
  attribution: string;
}

/** The base map in a frame, if the console has one that is not hidden; `redraw`
 * is called when more of it is there. */
function useBaseMap(frame: Frame|undefined, redraw: () => void):
    {base: BaseMap|undefined, error: string|undefined} {
  const [base, setBase] = useState<BaseMap>();
  const [error, setError] = useState<string>();
  useEffect(() => {
    if (!frame) {
      setBase(undefined);
      return undefined;
    }
    let end: (() => void)|undefined;
    let gone = false;
    import('./ground.js').then(({Ground: Made, tileStore}) => {
      if (gone) return;
      const store = tileStore();
      const ground = new Made(store, frame);
      const ends = [
        effect(() => {
          const archive = store.archive.value;
          setBase(archive && {ground, attribution: archive.attribution});
        }),
        effect(() => setError(store.error.value)),
        store.arrivals.subscribe(redraw),
      ];
      end = () => ends.forEach(stop => stop());
    }).catch((reason: Error) => setError(reason.message));
    return () => {
      gone = true;
      end?.();
    };
  }, [frame]);
  return {base, error};
}

/** Where a pointer is, in pixels and in metres, and at what. */
interface Pointer {
  left: number;
  top: number;
  x: number;
  y: number;
  hit: Hit|undefined;
}

interface Props {
  scene: Scene;
  /** How the map lies on the earth, where that is known. */
  frame?: Frame;
  /** The map in words, for those who do not see it. */
  label: string;
  /** Tells others what is in view: an export draws the same. */
  shownRef?: {current: MapSheet|undefined};
  /** Key of the things that stand out. */
  pointed?: string;
  /** Told the key of the thing that somebody points at. */
  onPoint?: (key: string|undefined) => void;
  /** Whether it is a small map beside others, without a legend. */
  small?: boolean;
}

/** Where a point of the map is, for people. */
function pointText(frame: Frame|undefined, x: number, y: number): string {
  return frame ? placeText(toEarth(frame, x, y)) :
                 `x ${fixed(x, 1)}, y ${fixed(y, 1)} m`;
}

function Legend({shapes}: {shapes: Shape[]}) {
  return (
    <ul class="legend">
      {shapes.filter(({label}) => label !== '').map(shape => (
        <li key={shape.id}>
          <span class={`swatch ${shape.colour} ${
              shape.kind === 'strokes' && shape.dash ? 'dashed' : ''}`} />
          {shape.label}
        </li>
      ))}
    </ul>
  );
}

/** A map that can be moved with mouse, finger and keys. */
export function MapView(
    {scene, frame, label, shownRef, pointed, onPoint, small}: Props) {
  const parent = useRef<HTMLDivElement>(null);
  const drawing = useRef<MapDrawing>();
  const [view, setView] = useState<View>();
  const [pointer, setPointer] = useState<Pointer>();
  const canHaveBase = frame !== undefined && consoleSettings.value?.baseMap;
  const isHidden = query.value.get('base') === 'off';
  const {base, error} = useBaseMap(
      canHaveBase && !isHidden ? frame : undefined,
      () => drawing.current?.draw());
  const graticule = useMemo(
      () => frame && !base ? new Graticule(frame) : undefined,
      [frame, base]);
  const latest = useRef({scene, base, graticule, onPoint});
  latest.current = {scene, base, graticule, onPoint};
  useEffect(() => {
    const sheetOf = (shown: View): MapSheet => ({
      get scene() {
        const {scene: now, graticule: lines} = latest.current;
        return lines ? {...now, shapes: [lines.shape, ...now.shapes]} : now;
      },
      get labels() {
        return latest.current.graticule?.labelsIn(shown) ?? [];
      },
      view: shown,
      ground: async () => {
        const below = latest.current.base;
        const picture = await below?.ground.picture(shown);
        return below && picture !== undefined ?
            {picture, attribution: attributionText(below.attribution)} :
            undefined;
      },
    });
    const made = new MapDrawing(parent.current!, now => {
      if (shownRef) shownRef.current = sheetOf(now);
      setView(now);
    }, at => {
      setPointer(at);
      latest.current.onPoint?.(at?.hit?.key);
    });
    drawing.current = made;
    const end = effect(() => {
      dark.value;
      made.draw();
    });
    return () => {
      end();
      made.close();
      if (shownRef) shownRef.current = undefined;
    };
  }, []);
  useEffect(() => drawing.current!.show(scene), [scene]);
  useEffect(() => drawing.current!.showGround(base?.ground), [base]);
  useEffect(() => drawing.current!.showGraticule(graticule), [graticule]);
  useEffect(() => drawing.current!.select(pointed), [pointed]);
  const metersPerPixel = view?.metersPerPixel ?? 1;
  const bar = scaleBarMeters(metersPerPixel, small ? 70 : 120);
  const {x, y} = pointer ?? view ?? {x: 0, y: 0};
  return (
    <figure class={small ? 'map small' : 'map'} aria-label={label}>
      <div class="canvas" ref={parent}>
        {view && graticule?.labelsIn(view).map(({text, left, top}) => (
          <span key={text} class="degrees" aria-hidden="true"
                style={{left: `${left}px`, top: `${top}px`}}>{text}</span>
        ))}
        {view && namesIn(scene, view).map(
            ({text, colour, left, top, isBefore}) => (
          <span key={`${left} ${top}`} aria-hidden="true"
                class={isBefore ? 'place-name before' : 'place-name'}
                style={{left: `${left}px`, top: `${top}px`}}>
            <span class={`swatch ${colour}`} />{text}
          </span>
        ))}
        <p class="scale">
          <span class="bar" style={{width: `${bar / metersPerPixel}px`}} />
          {length(bar)}
          {!small && (
            <span class="place">
              {pointer ? '' : 'centre '}{pointText(frame, x, y)}
            </span>
          )}
        </p>
        {pointer?.hit && (
          <p class="tip" style={{
            left: `${Math.min(pointer.left + 14, (view?.width ?? 0) - 190)}px`,
            top: `${pointer.top + 14}px`,
          }}>{pointer.hit.tip}</p>
        )}
        {base?.attribution && (
          <p class="attribution"><Attribution html={base.attribution} /></p>
        )}
      </div>
      {!small && <Legend shapes={scene.shapes} />}
      {error && canHaveBase && !isHidden &&
        <p class="error" role="status">The base map: {error}</p>}
      <div class="map-tools">
        {canHaveBase && !small && (
          <label class="check">
            <input type="checkbox" checked={!isHidden}
                   onChange={event => setQuery('base',
                       event.currentTarget.checked ? undefined : 'off')} />
            Base map
          </label>
        )}
        {!small && (
          <button type="button" onClick={() => drawing.current!.fitAgain()}>
            Show all
          </button>
        )}
      </div>
    </figure>
  );
}
