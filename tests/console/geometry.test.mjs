// The geometry of maps, without a browser.
import assert from 'node:assert/strict';
import {before, test} from 'node:test';

import {load} from './world.mjs';

let pyramid, path, rigid, ellipse;
before(async () => {
  [pyramid, path, rigid, ellipse] = await Promise.all(
      ['pyramid', 'path', 'rigid', 'ellipse'].map(
          name => load(`web/geometry/${name}.ts`)));
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

test('a path that is cut is drawn in two, a part up to its last node', () => {
  const graph = winding(300, 100);
  const view = {x: 0, y: 0, metersPerPixel: 0.01, width: 1e6, height: 1e6};
  const all = new path.PathDrawer(graph, 0, 299).segmentsIn(view);
  assert.equal(all.length / 4, 298);
  const part = new path.PathDrawer(graph, 150, 200).segmentsIn(view);
  assert.equal(part.length / 4, 50);
  assert.ok(Math.abs(part.at(-2) - graph.x[200]) < 1e-3);
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
