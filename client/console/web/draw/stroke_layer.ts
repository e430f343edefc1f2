import {Layer, type LayerProps, project32, type UpdateParameters} from
    '@deck.gl/core';
import {Geometry, Model} from '@luma.gl/engine';

export interface StrokeLayerProps extends LayerProps {
  /** Segments x0, y0, x1, y1 in metres. Another array means other segments. */
  segments: Float32Array;
  /** Red, green and blue in [0, 1]. */
  colour: [number, number, number];
  widthPixels: number;
}

const uniformBlock = `\
layout(std140) uniform strokeUniforms {
  vec3 colour;
  float widthPixels;
} stroke;
`;

const strokeUniforms = {
  name: 'stroke',
  vs: uniformBlock,
  fs: uniformBlock,
  uniformTypes: {colour: 'vec3<f32>', widthPixels: 'f32'},
} as const;

const vs = `#version 300 es
in vec2 here;
in vec2 there;
in float side;
void main(void) {
  vec4 p = project_position_to_clipspace(vec3(here, 0.), vec3(0.), vec3(0.));
  vec4 q = project_position_to_clipspace(vec3(there, 0.), vec3(0.), vec3(0.));
  vec2 along = (q.xy - p.xy) * project.viewportSize;
  float size = max(length(along), 1e-6);
  vec2 across = vec2(-along.y, along.x) / size * side * stroke.widthPixels / 2.;
  gl_Position = p + vec4(project_pixel_size_to_clipspace(across), 0., 0.);
}
`;

const fs = `#version 300 es
precision highp float;
out vec4 fragColor;
void main(void) {
  fragColor = vec4(stroke.colour, layer.opacity);
}
`;

const CORNERS = 6;

/** Two triangles for each segment. At the far end the line leads back, so that
 * the sides change. */
function geometryOf(segments: Float32Array): Geometry {
  const vertexCount = segments.length / 4 * CORNERS;
  const here = new Float32Array(2 * vertexCount);
  const there = new Float32Array(2 * vertexCount);
  const side = new Float32Array(vertexCount);
  const corners: Array<[number, number]> =
      [[0, 1], [0, -1], [1, 1], [1, 1], [1, -1], [0, 1]];
  let vertex = 0;
  for (let i = 0; i < segments.length; i += 4) {
    for (const [end, sign] of corners) {
      const near = i + 2 * end;
      const far = i + 2 - 2 * end;
      here[2 * vertex] = segments[near];
      here[2 * vertex + 1] = segments[near + 1];
      there[2 * vertex] = segments[far];
      there[2 * vertex + 1] = segments[far + 1];
      side[vertex++] = sign;
    }
  }
  return new Geometry({
    topology: 'triangle-list',
    vertexCount,
    attributes: {
      here: {size: 2, value: here},
      there: {size: 2, value: there},
      side: {size: 1, value: side},
    },
  });
}

/**
 * Lines of one colour and a width in pixels. deck.gl's LineLayer draws each
 * segment as an instance, which costs software renderers some microseconds
 * each; here all are drawn at once.
 */
export class StrokeLayer extends Layer<StrokeLayerProps> {
  static override layerName = 'StrokeLayer';
  declare state: {model?: Model};

  override getShaders() {
    return super.getShaders({vs, fs, modules: [project32, strokeUniforms]});
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
    const {colour, widthPixels} = this.props;
    model.shaderInputs.setProps({stroke: {colour, widthPixels}});
    model.draw(this.context.renderPass);
  }
}
