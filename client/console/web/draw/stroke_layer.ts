import {Layer, type LayerProps, type UpdateParameters} from '@deck.gl/core';
import {Geometry, Model} from '@luma.gl/engine';

import type {View} from '../geometry/view.js';

export interface StrokeLayerProps extends LayerProps {
  /** Segments x0, y0, x1, y1 in metres. Another array means other segments. */
  segments: Float32Array;
  /** Red, green and blue in [0, 1]. */
  colour: [number, number, number];
  widthPixels: number;
  /** Pixels that are drawn and left out in turn, on and on over segments of which
   * each begins where the one before it ends; all are drawn for [1, 0]. */
  dashPixels: [number, number];
  view: View;
}

const uniformBlock = `\
layout(std140) uniform strokeUniforms {
  vec2 centreMeters;
  vec2 sizePixels;
  vec3 colour;
  float pixelsPerMeter;
  vec2 dashPixels;
  float widthPixels;
} stroke;
`;

const strokeUniforms = {
  name: 'stroke',
  vs: uniformBlock,
  fs: uniformBlock,
  uniformTypes: {
    centreMeters: 'vec2<f32>',
    sizePixels: 'vec2<f32>',
    colour: 'vec3<f32>',
    pixelsPerMeter: 'f32',
    dashPixels: 'vec2<f32>',
    widthPixels: 'f32',
  },
} as const;

// Half a pixel more than the width, in which the edge fades.
const vs = `#version 300 es
in vec4 segment;
in vec2 corner;
in float metersBefore;
out float fromMiddle;
out float fromBegin;
void main(void) {
  vec2 from = (segment.xy - stroke.centreMeters) * stroke.pixelsPerMeter;
  vec2 to = (segment.zw - stroke.centreMeters) * stroke.pixelsPerMeter;
  vec2 along = (to - from) / max(length(to - from), 1e-6);
  fromBegin = metersBefore * stroke.pixelsPerMeter +
      corner.x * length(to - from);
  fromMiddle = corner.y * (stroke.widthPixels / 2. + 0.5);
  vec2 place = mix(from, to, corner.x) +
      vec2(-along.y, along.x) * fromMiddle;
  gl_Position = vec4(2. * place / stroke.sizePixels, 0., 1.);
}
`;

const fs = `#version 300 es
precision highp float;
in float fromMiddle;
in float fromBegin;
out vec4 fragColor;
void main(void) {
  if (stroke.dashPixels.y > 0. &&
      mod(fromBegin, stroke.dashPixels.x + stroke.dashPixels.y) >
          stroke.dashPixels.x) discard;
  float covered = stroke.widthPixels / 2. + 0.5 - abs(fromMiddle);
  fragColor = vec4(stroke.colour, clamp(covered, 0., 1.));
}
`;

/** Which end, and which side of the line. */
const CORNERS = [0, 1, 0, -1, 1, 1, 1, -1];
const TRIANGLES = [0, 1, 2, 2, 1, 3];

/** Two triangles for each segment. */
function geometryOf(segments: Float32Array): Geometry {
  const count = segments.length / 4;
  const segment = new Float32Array(16 * count);
  const corner = new Float32Array(8 * count);
  const metersBefore = new Float32Array(4 * count);
  let meters = 0;
  const indices = new Uint32Array(6 * count);
  for (let i = 0; i < count; ++i) {
    const ends = segments.subarray(4 * i, 4 * i + 4);
    for (let c = 0; c < 4; ++c) segment.set(ends, 16 * i + 4 * c);
    corner.set(CORNERS, 8 * i);
    const goesOn = i > 0 && segments[4 * i - 2] === ends[0] &&
        segments[4 * i - 1] === ends[1];
    if (!goesOn) meters = 0;
    metersBefore.fill(meters, 4 * i, 4 * i + 4);
    meters += Math.hypot(ends[2] - ends[0], ends[3] - ends[1]);
    for (let k = 0; k < 6; ++k) indices[6 * i + k] = 4 * i + TRIANGLES[k];
  }
  return new Geometry({
    topology: 'triangle-list',
    vertexCount: indices.length,
    indices,
    attributes: {
      segment: {size: 4, value: segment},
      corner: {size: 2, value: corner},
      metersBefore: {size: 1, value: metersBefore},
    },
  });
}

/**
 * Lines of one colour and a width in pixels, on a flat map. deck.gl's LineLayer
 * draws each segment as an instance, which costs software renderers some
 * microseconds each; here all are drawn at once.
 */
export class StrokeLayer extends Layer<StrokeLayerProps> {
  static override layerName = 'StrokeLayer';
  declare state: {model?: Model};

  override getShaders() {
    return super.getShaders({vs, fs, modules: [strokeUniforms]});
  }

  override initializeState(): void {}

  override updateState(parameters: UpdateParameters<this>): void {
    super.updateState(parameters);
    const {segments} = this.props;
    if (segments === parameters.oldProps.segments) return;
    this.state.model?.destroy();
    this.setState({
      model: segments.length === 0 ? undefined :
          new Model(this.context.device, {
            ...this.getShaders(),
            id: this.props.id,
            geometry: geometryOf(segments),
          }),
    });
  }

  override draw(): void {
    const {model} = this.state;
    if (!model) return;
    const {colour, widthPixels, dashPixels, view} = this.props;
    model.shaderInputs.setProps({stroke: {
      centreMeters: [view.x, view.y],
      sizePixels: [view.width, view.height],
      colour,
      pixelsPerMeter: 1 / view.metersPerPixel,
      dashPixels,
      widthPixels,
    }});
    model.draw(this.context.renderPass);
  }
}
