// The geometry of maps, without a browser.
import assert from 'node:assert/strict';
import {before, test} from 'node:test';

import {load} from './world.mjs';

let pyramid, path, rigid, ellipse, frames, graphs, graticules, links,
    recordings;
before(async () => {
  [pyramid, path, rigid, ellipse, frames] = await Promise.all(
      ['pyramid', 'path', 'rigid', 'ellipse', 'frame'].map(
          name => load(`web/geometry/${name}.ts`)));
  [graphs, graticules, links, recordings] = await Promise.all(
      ['web/data/graph.ts', 'web/draw/graticule.ts', 'shared/links.ts',
       'web/data/recordings.ts'].map(name => load(name)));
});

/** A winding path of 2 m steps that is cut once. */
function winding(size, cut) {
  const graph = {size, x: new Float64Array(size), y: new Float64Array(size),
                 joined: new Uint8Array(size).fill(1)};
  graph.joined[0] = graph.joined[cut] = 0;
  let heading = 0;
  for (let i = 1; i < size; ++i) {
    heading += 0.05 * Math.sin(i / 30) + 0.04 * Math.sin(i / 7);
    graph.x[i] = graph.x[i - 1] + 2 * Math.cos(heading);
    graph.y[i] = graph.y[i - 1] + 2 * Math.sin(heading);
  }
  graph.pyramid = pyramid.buildPyramid(graph.x, graph.y, graph.joined);
  return graph;
}

function distanceToSegment(x, y, [x0, y0, x1, y1]) {
  const [dx, dy] = [x1 - x0, y1 - y0];
  const square = dx * dx + dy * dy;
  const along = square === 0 ? 0 : Math.min(1, Math.max(
      0, ((x - x0) * dx + (y - y0) * dy) / square));
  return Math.hypot(x0 + along * dx - x, y0 + along * dy - y);
}

function segmentsOf(drawn) {
  return Array.from({length: drawn.length / 4},
                    (_, i) => drawn.subarray(4 * i, 4 * i + 4));
}

test('no node lies farther from the drawn path than half a pixel', () => {
  const graph = winding(6000, 2500);
  for (const metersPerPixel of [0.5, 3, 20, 100]) {
    const view = {x: 0, y: 0, metersPerPixel, width: 1e5, height: 1e5};
    const drawn = segmentsOf(
        new path.PathDrawer(graph, 0, graph.size - 1).segmentsIn(view));
    assert.ok(drawn.length > 0 && drawn.length < graph.size);
    for (let i = 0; i < graph.size; i += 7) {
      const distance = Math.min(...drawn.map(
          ends => distanceToSegment(graph.x[i], graph.y[i], ends)));
      assert.ok(distance <= 0.53 * metersPerPixel, `${distance} m at node ${
          i}, ${metersPerPixel} m a pixel`);
    }
  }
});

test('a graph that grew piece by piece is the one that is made at once', () => {
  const ends = [900, 901, 2048, 2049, 2500, 2501, 4600, 6000];
  const whole = winding(6000, 2500);
  const items = {sequence: 1, fraction: 1, time: 1, travelled: 1, x: 1, y: 1,
                 heading: 1, covariance: 3, joined: 1};
  const all = {...graphs.noNodes(6000), x: whole.x, y: whole.y,
               joined: whole.joined};
  all.covariance.forEach((_, i) => all.covariance[i] = i);
  const nodes = (from, to) => Object.fromEntries(Object.entries(items).map(
      ([name, width]) => [name, all[name].slice(width * from, width * to)]));
  let graph = {...nodes(0, 900), size: 900, revision: 1, nodesId: 'a',
               closures: new Uint32Array(0)};
  graph.pyramid = pyramid.buildPyramid(graph.x, graph.y, graph.joined);
  const first = graph;
  const before = first.x.slice();
  ends.slice(1).forEach((end, i) => {
    graph = graphs.grown(graph, {revision: i + 2, nodes: nodes(ends[i], end),
                                 closures: Uint32Array.of(1, i)});
  });
  assert.equal(graph.size, 6000);
  assert.equal(graph.revision, ends.length);
  for (const name of Object.keys(items)) {
    assert.deepEqual(graph[name], all[name], name);
  }
  assert.deepEqual(graph.pyramid, whole.pyramid);
  // What others look at meanwhile stays as it was.
  assert.deepEqual(first.x, before);
});

test('lines of latitude and longitude lie where their numbers say', () => {
  for (const frame of [frames.mercatorFrame({latitude: 52.5, longitude: 13.4}),
                       frames.tangentFrame({latitude: -33.9, longitude: 151.2},
                                           40)]) {
    for (const metersPerPixel of [0.05, 2, 100]) {
      const view = {x: 900, y: -400, metersPerPixel, width: 900, height: 500};
      const made = new graticules.Graticule(frame);
      const labels = made.labelsIn(view);
      assert.ok(labels.length >= 3 && labels.length < 40, `${labels.length}`);
      for (const {text, left, top} of labels) {
        const x = view.x + (left - view.width / 2) * metersPerPixel;
        const y = view.y - (top - view.height / 2) * metersPerPixel;
        const place = frames.toEarth(frame, x, y);
        const [degrees, side] = text.split('° ');
        const said = Number(degrees) * (/[NE]/.test(side) ? 1 : -1);
        const got = /[NS]/.test(side) ? place.latitude : place.longitude;
        assert.ok(Math.abs(said - got) * 111_000 < 5 * metersPerPixel,
                  `${text} at ${got}`);
      }
      assert.ok(made.shape.segmentsIn(view).length > 0);
    }
  }
});

test('a link holds the values of its pair, encoded, and nothing else', () => {
  const values = {vehicle: 'a&b', pose_a: '12', pose_b: '3',
                  time_a: '2026-01-01T00:00:00.250Z', time_b: undefined,
                  unix_a: '1.000', unix_b: undefined};
  const link = template => links.linkFor({name: 'x', template}, values);
  assert.equal(link('https://host/{vehicle}?t={time_a}#{pose_b}'),
               'https://host/a%26b?t=2026-01-01T00%3A00%3A00.250Z#3');
  assert.equal(link('https://host/{time_b}'), undefined);
  for (const template of [
    'javascript:alert({pose_a})', 'https://{vehicle}/', 'https://host{pose_a}/',
    'http:{vehicle}', 'ftp://host/{vehicle}', 'https://host/{pose_c}',
    'https://me:secret@host/{vehicle}', '//host/{vehicle}', 'https://',
  ]) {
    assert.notEqual(links.problemOf(template), undefined, template);
    assert.equal(link(template), undefined, template);
  }
});

test('a path that is cut is drawn in two, a part up to its last node', () => {
  const graph = winding(300, 100);
  const view = {x: 0, y: 0, metersPerPixel: 0.01, width: 1e6, height: 1e6};
  const all = new path.PathDrawer(graph, 0, 299).segmentsIn(view);
  assert.equal(all.length / 4, 298);
  const part = new path.PathDrawer(graph, 150, 200).segmentsIn(view);
  assert.equal(part.length / 4, 50);
  assert.ok(Math.abs(part.at(-2) - graph.x[200]) < 1e-3);
});

/** A graph of which each node is a pose, cut into two recordings. */
function recorded(cut) {
  const graph = {...graphs.noNodes(300), ...winding(300, cut), nodesId: 'a',
                 closures: new Uint32Array(0)};
  graph.sequence = Float64Array.from({length: 300}, (_, i) => i + 1);
  for (let i = 0; i < 300; ++i) graph.covariance.set([4, 0.5, 1], 3 * i);
  return graph;
}

const started = (sequence, more) => ({
  name: `vehicles/v/recordings/${sequence}`, label: '',
  firstSequence: BigInt(sequence), lastSequence: 300n, frameState: 1, ...more});

test('a recording is drawn where its frame lies in that of the last one', () => {
  const own = recorded(100);
  const before = own.x.slice();
  const {graph, recordings: placed} = recordings.place(own, [
    started(1, {framePose: {xMeters: 10, yMeters: -3,
                            headingRadians: Math.PI / 2},
                frameReference: {xMeters: 2, yMeters: 1, headingRadians: 0},
                frameCovariance: {form: 1, values: [9, 0, 0, 4, 0, 0.01]}}),
    started(101, {framePose: {xMeters: 0, yMeters: 0, headingRadians: 0}})]);
  for (const i of [0, 40, 99]) {
    assert.ok(Math.abs(graph.x[i] - (10 - own.y[i])) < 1e-9);
    assert.ok(Math.abs(graph.y[i] - (-3 + own.x[i])) < 1e-9);
    assert.ok(Math.abs(graph.heading[i] - own.heading[i] - Math.PI / 2) < 1e-9);
    const turned = [...graph.covariance.subarray(3 * i, 3 * i + 3)];
    [1, -0.5, 4].forEach((value, k) =>
        assert.ok(Math.abs(turned[k] - value) < 1e-9, `${turned}`));
  }
  assert.equal(graph.x[200], own.x[200]);
  // The graph that came stays as it was, and others are drawn by their boxes.
  assert.deepEqual(own.x, before);
  const view = {x: 10, y: -3, metersPerPixel: 0.01, width: 1e6, height: 1e6};
  const drawn = new path.StretchesDrawer(graph, [[0, 99], [100, 299]]);
  assert.equal(drawn.segmentsIn(view).length / 4, 298);
  assert.equal(drawn.segmentsIn(view), drawn.segmentsIn(view));
  assert.deepEqual(placed.map(({from, to, isPlaced}) => [from, to, isPlaced]),
                   [[0, 99, true], [100, 299, true]]);
  const [{doubt}] = placed;
  assert.ok(Math.abs(doubt.x - 9) < 1e-9 && Math.abs(doubt.y + 1) < 1e-9);
  assert.deepEqual(doubt.covariance, [9, 0, 4]);
  assert.ok(Math.abs(doubt.headingDeviation - 0.1) < 1e-9);
  assert.equal(recordings.recordingOf(placed, 99), placed[0]);
  assert.equal(recordings.recordingOf(placed, 100), placed[1]);
});

test('one recording, or one that has no nodes yet, leaves the graph as it is',
     () => {
  const own = recorded(100);
  for (const list of [[], [started(1, {})], [started(1, {}),
                                             started(301, {})]]) {
    const {graph, recordings: placed} = recordings.place(own, list);
    assert.equal(graph, own);
    assert.deepEqual(placed, []);
  }
  assert.notEqual(recordings.tiesOf(own), recordings.tiesOf(
      {...own, closures: Uint32Array.of(1, 2)}));
});

test('a motion of points is found again', () => {
  const motion = {angle: 2.5, x: -30, y: 4};
  const from = [0, 0, 10, 0, 10, 5, -3, 8];
  const to = [];
  for (let i = 0; i < from.length; i += 2) {
    to.push(...rigid.apply(motion, from[i], from[i + 1]));
  }
  const found = rigid.fit(from, to);
  for (const name of ['angle', 'x', 'y']) {
    assert.ok(Math.abs(found[name] - motion[name]) < 1e-9, name);
  }
});

test('an ellipse holds 95 % of its Gaussian', () => {
  // Deviations 3 m and 1 m, the longer one at 30 degrees. The radius of 95 % in
  // the plane is the root of the chi-square quantile 5.991.
  const [c, s] = [Math.cos(Math.PI / 6), Math.sin(Math.PI / 6)];
  const {long, short, direction} = ellipse.ellipse95(
      9 * c * c + s * s, 8 * c * s, 9 * s * s + c * c);
  assert.ok(Math.abs(long - 3 * Math.sqrt(5.991)) < 1e-3);
  assert.ok(Math.abs(short - Math.sqrt(5.991)) < 1e-3);
  assert.ok(Math.abs(direction - Math.PI / 6) < 1e-9);
});

test('names stay within the map, and none lies over another', async () => {
  const scenes = await load('web/draw/scene.ts');
  const view = {x: 0, y: 0, metersPerPixel: 1, width: 400, height: 200};
  const name = (text, x, y) => ({text, colour: 'path', x, y});
  const shown = scenes.namesIn({shapes: [], box: undefined, names: [
    name('first', 0, 0), name('hidden', 20, 5), name('right', 190, 50),
    name('outside', 300, 0), name('long '.repeat(20), -190, -50)]}, view);
  assert.deepEqual(shown.map(({text, isBefore}) => [text.length, isBefore]),
                   [[5, false], [5, true], [28, false]]);
});
