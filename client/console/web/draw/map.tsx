import {Deck, type Layer, OrthographicView} from '@deck.gl/core';
import {ScatterplotLayer} from '@deck.gl/layers';
import {effect} from '@preact/signals';
import {useEffect, useRef, useState} from 'preact/hooks';

import {type View, viewOf} from '../geometry/view.js';
import {go} from '../route.js';
import {dark} from '../theme.js';
import {length} from '../parts/format.js';
import {colourOf, components, linkAt, scaleBarMeters, type Scene, type Shape}
    from './scene.js';
import {StrokeLayer} from './stroke_layer.js';

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
  private view: DeckView = {target: [0, 0, 0], zoom: 0};
  private width = 0;
  private height = 0;
  /** Once somebody has moved the map it stays where it is. */
  private moved = false;
  private fitted = '';
  /** Where a click would lead. */
  private hovered: string|undefined;

  constructor(parent: HTMLDivElement,
              private readonly onView: (view: View) => void) {
    this.deck = new Deck({
      parent,
      // The layers smooth their own edges, which costs software renderers less.
      deviceProps: {type: 'webgl', webgl: {antialias: false}},
      views: new OrthographicView({id: 'map', flipY: false}),
      controller: {keyboard: true, inertia: true},
      viewState: this.view,
      getCursor: ({isDragging}) =>
          isDragging ? 'grabbing' : this.hovered ? 'pointer' : 'grab',
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
        this.hovered = linkAt(this.scene, this.current(), x, y);
      },
      onClick: ({x, y}) => {
        const link = linkAt(this.scene, this.current(), x, y);
        if (link) go(link);
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
      layers: this.scene.shapes.map(shape => layerOf(shape, view)),
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

interface Props {
  scene: Scene;
  /** What the map shows, for those who do not see it. */
  label: string;
  /** Tells others what is in view: an export draws the same. */
  viewRef: {current: View|undefined};
}

/** A map that can be moved with mouse, finger and keys. */
export function MapView({scene, label, viewRef}: Props) {
  const parent = useRef<HTMLDivElement>(null);
  const drawing = useRef<MapDrawing>();
  const [metersPerPixel, setMetersPerPixel] = useState(1);
  useEffect(() => {
    const made = new MapDrawing(parent.current!, view => {
      viewRef.current = view;
      setMetersPerPixel(view.metersPerPixel);
    });
    drawing.current = made;
    const end = effect(() => {
      dark.value;
      made.draw();
    });
    return () => {
      end();
      made.close();
    };
  }, []);
  useEffect(() => drawing.current!.show(scene), [scene]);
  const bar = scaleBarMeters(metersPerPixel, 120);
  return (
    <figure class="map" aria-label={label}>
      <div class="canvas" ref={parent}>
        <p class="scale">
          <span class="bar" style={{width: `${bar / metersPerPixel}px`}} />
          {length(bar)}
        </p>
      </div>
      <ul class="legend">
        {scene.shapes.map(({id, label, colour: name}) => (
          <li key={id}><span class={`swatch ${name}`} />{label}</li>
        ))}
      </ul>
      <div class="map-tools">
        <button type="button" onClick={() => drawing.current!.fitAgain()}>
          Show all
        </button>
      </div>
    </figure>
  );
}
