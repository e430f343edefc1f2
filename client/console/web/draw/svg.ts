// Files of what is in view: an SVG is written, and a PNG is that SVG drawn.
import type {View} from '../geometry/view.js';
import type {Fact} from '../parts/facts.js';
import {length} from '../parts/format.js';
import {type Curve, isSingle, type Series} from './curve.js';
import type {LineLabel} from './graticule.js';
import {colourOf, namesIn, scaleBarMeters, type Scene, type Shape} from
    './scene.js';

/** A map as it is at the moment. */
export interface MapSheet {
  scene: Scene;
  view: View;
  /** Numbers of degrees at the lines of latitude and longitude. */
  labels?: LineLabel[];
  /** Draws the base map below it, if there is one. */
  ground?: () => Promise<GroundSheet|undefined>;
}

/** A base map as a file shows it. */
export interface GroundSheet {
  /** Address of a picture of the view, with its data in it. */
  picture: string;
  attribution: string;
}

/** The contents of a file, from top to bottom. */
export interface Sheet {
  title: string;
  map?: MapSheet;
  curves?: Curve[];
  facts?: Fact[];
}

const MARGIN = 16;
const LINE = 18;
const CURVE_HEIGHT = 160;
const LEAST_WIDTH = 640;
const FACT_NAME_WIDTH = 320;

function escaped(text: string): string {
  return text.replaceAll('&', '&amp;').replaceAll('<', '&lt;')
      .replaceAll('"', '&quot;');
}

function text(x: number, y: number, content: string, style = ''): string {
  return `<text x="${x}" y="${y}" fill="${colourOf('text')}" ${style}>` +
      `${escaped(content)}</text>`;
}

function round(value: number): string {
  return String(Math.round(value * 100) / 100);
}

function shapeToSvg(shape: Shape, view: View): string {
  const colour = colourOf(shape.colour);
  const px = (x: number) =>
      round(view.width / 2 + (x - view.x) / view.metersPerPixel);
  const py = (y: number) =>
      round(view.height / 2 - (y - view.y) / view.metersPerPixel);
  if (shape.kind === 'dots') {
    const {positions, radiusPixels} = shape;
    let circles = '';
    for (let i = 0; i < positions.length; i += 2) {
      circles += `<circle cx="${px(positions[i])}" cy="${
          py(positions[i + 1])}" r="${radiusPixels}"/>`;
    }
    return `<g fill="${colour}"><title>${escaped(shape.label)}</title>` +
        `${circles}</g>`;
  }
  const segments = shape.segmentsIn(view);
  let path = '';
  let end = '';
  for (let i = 0; i < segments.length; i += 4) {
    const begin = `${px(segments[i])} ${py(segments[i + 1])}`;
    if (begin !== end) path += `M${begin}`;
    end = `${px(segments[i + 2])} ${py(segments[i + 3])}`;
    path += `L${end}`;
  }
  return `<path d="${path}" fill="none" stroke="${colour}" stroke-width="${
      shape.widthPixels}"${
      shape.dash ? ` stroke-dasharray="${shape.dash.join(' ')}"` : ''
      } stroke-linejoin="round"><title>${
      escaped(shape.label)}</title></path>`;
}

function groundToSvg({picture, attribution}: GroundSheet,
                     {width, height}: View): string {
  return `<image href="${picture}" width="${width}" height="${height}"/>` +
      text(width - 6, height - 6, attribution,
           'text-anchor="end" font-size="10"');
}

function mapToSvg({scene, view, labels = []}: MapSheet, ground: GroundSheet|undefined):
    string {
  const bar = scaleBarMeters(view.metersPerPixel, 120);
  const barPixels = bar / view.metersPerPixel;
  const y = view.height - 12;
  const legend = scene.shapes.filter(({label}) => label !== '').map(
      (shape, i) => `<path d="M12 ${14 + i * LINE}h22" stroke-width="4" ` +
          `stroke="${colourOf(shape.colour)}"${
              shape.kind === 'strokes' && shape.dash ?
                  ` stroke-dasharray="${shape.dash.join(' ')}"` : ''}/>` +
          text(40, 18 + i * LINE, shape.label));
  return `<svg width="${view.width}" height="${view.height}">` +
      (ground ? groundToSvg(ground, view) : '') +
      scene.shapes.map(shape => shapeToSvg(shape, view)).join('') +
      labels.map(({text: degrees, left, top}) => text(
          left + 3, top + 12, degrees, 'font-size="10"')).join('') +
      namesIn(scene, view).map(({text: name, left, top, isBefore}) =>
          text(left + (isBefore ? -8 : 8), top + 4, name,
               `paint-order="stroke" stroke="${
                   colourOf('background')}" stroke-width="3"${
                   isBefore ? ' text-anchor="end"' : ''}`)).join('') +
      legend.join('') +
      `<path d="M12 ${y}h${round(barPixels)}" stroke="${
          colourOf('text')}" stroke-width="3"/>` +
      text(20 + barPixels, y + 4, length(bar)) + '</svg>';
}

function seriesToSvg(series: Series, points: Array<[number, number]|null>,
                     breaks: boolean): string {
  const colour = colourOf(series.colour);
  if (series.as === 'points' || isSingle(points)) {
    return points.map(point => point ?
        `<circle cx="${round(point[0])}" cy="${round(point[1])}" r="2.5" ` +
            `fill="${colour}"/>` : '').join('');
  }
  let path = '';
  let isBegun = false;
  for (const point of points) {
    if (point) {
      path += `${isBegun ? 'L' : 'M'}${round(point[0])} ${round(point[1])}`;
      isBegun = true;
    } else if (breaks) {
      isBegun = false;
    }
  }
  return `<path d="${path}" fill="none" stroke="${colour}" stroke-width="1.5"${
      series.as === 'dashes' ? ' stroke-dasharray="6 4"' : ''}/>`;
}

function curveToSvg(curve: Curve, width: number): string {
  const scaled = (value: number) =>
      curve.logarithmic ? Math.log10(value) : value;
  const values = curve.series.flatMap(({values: all}) => all)
                     .filter(value => value !== null)
                     .filter(value => !curve.logarithmic || value > 0);
  const range = (all: number[]): [number, number] => {
    const [least, most] = all.reduce<[number, number]>(
        ([low, high], value) => [Math.min(low, value), Math.max(high, value)],
        [Infinity, -Infinity]);
    return least < most ? [least, most] : [least - 1, least + 1];
  };
  if (values.length === 0) return text(0, LINE, `${curve.title}: nothing yet`);
  const [x0, x1] = curve.xRange ?? range(curve.x);
  const [y0, y1] = range(values.map(scaled));
  const left = 64;
  const top = 28;
  const right = width - 8;
  const bottom = CURVE_HEIGHT - 24;
  const px = (x: number) => left + (x - x0) / (x1 - x0) * (right - left);
  const py = (y: number) =>
      bottom - (scaled(y) - y0) / (y1 - y0) * (bottom - top);
  const number = (value: number) => String(
      Number.isInteger(value) ? value :
      Math.abs(value) < 1e-9 ? 0 :
                               Number(value.toPrecision(3)));
  const unscaled = (y: number) => curve.logarithmic ? 10 ** y : y;
  let legendX = 8 * curve.title.length + 24;
  const legend = curve.series.map(({label, colour}) => {
    const entry = `<rect x="${legendX}" y="8" width="10" height="4" fill="${
        colourOf(colour)}"/>` + text(legendX + 14, 14, label);
    legendX += 7 * label.length + 32;
    return entry;
  });
  const drawn = curve.series.map(
      series => seriesToSvg(series, series.values.map(
          (value, i) => value === null || (curve.logarithmic && value <= 0) ?
              null : [px(curve.x[i]), py(value)]),
          curve.breaks ?? false));
  return text(0, 14, curve.title, 'font-weight="600"') + legend.join('') +
      `<path d="M${left} ${top}V${bottom}H${right}" fill="none" stroke="${
          colourOf('grid')}"/>` +
      text(0, top + 8, number(unscaled(y1))) +
      text(0, bottom, number(unscaled(y0))) +
      text(left, CURVE_HEIGHT - 6, number(x0)) +
      text(right, CURVE_HEIGHT - 6, `${number(x1)} ${curve.xLabel}`,
           'text-anchor="end"') +
      drawn.join('');
}

export async function sheetToSvg(
    {title, map, curves = [], facts = []}: Sheet): Promise<string> {
  const ground = await map?.ground?.();
  const inner = Math.max(LEAST_WIDTH, map?.view.width ?? 0);
  let y = MARGIN + LINE;
  let body = text(MARGIN, y - 4, title, 'font-size="16" font-weight="600"');
  y += 8;
  const place = (part: string, height: number) => {
    body += `<g transform="translate(${MARGIN} ${y})">${part}</g>`;
    y += height + MARGIN;
  };
  if (map) place(mapToSvg(map, ground), map.view.height);
  for (const curve of curves) place(curveToSvg(curve, inner), CURVE_HEIGHT);
  facts.forEach(([name, value]) => {
    place(text(0, 0, name, 'font-weight="600"') +
              text(FACT_NAME_WIDTH, 0, value),
          LINE - MARGIN);
  });
  const width = inner + 2 * MARGIN;
  const height = y + MARGIN;
  return `<svg xmlns="http://www.w3.org/2000/svg" width="${width}" height="${
      height}" viewBox="0 0 ${width} ${height}" font-family="sans-serif" ` +
      `font-size="12"><rect width="100%" height="100%" fill="${
          colourOf('background')}"/>${body}</svg>`;
}

function save(blob: Blob, name: string): void {
  const link = document.createElement('a');
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

export async function saveSvg(sheet: Sheet, name: string): Promise<void> {
  save(new Blob([await sheetToSvg(sheet)], {type: 'image/svg+xml'}),
       `${name}.svg`);
}

export async function savePng(sheet: Sheet, name: string): Promise<void> {
  const url = URL.createObjectURL(
      new Blob([await sheetToSvg(sheet)], {type: 'image/svg+xml'}));
  try {
    const image = new Image();
    image.src = url;
    await image.decode();
    const canvas = document.createElement('canvas');
    canvas.width = 2 * image.naturalWidth;
    canvas.height = 2 * image.naturalHeight;
    canvas.getContext('2d')!.drawImage(image, 0, 0, canvas.width,
                                       canvas.height);
    const png = await new Promise<Blob|null>(
        done => canvas.toBlob(done, 'image/png'));
    if (!png) throw new Error('The picture is too large to be a PNG here.');
    save(png, `${name}.png`);
  } finally {
    URL.revokeObjectURL(url);
  }
}
