// Colours that mean something, as people with and without all cones see them.
import assert from 'node:assert/strict';
import {readFileSync} from 'node:fs';
import {join} from 'node:path';
import {test} from 'node:test';

import {ROOT} from './world.mjs';

/** Linear red, green and blue as they look without red or green cones (Machado,
 * Oliveira and Fernandes 2009, severity 1). */
const SIGHTS = {
  'all cones': [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
  'protanopia': [[0.152286, 1.052583, -0.204868],
                 [0.114503, 0.786281, 0.099216],
                 [-0.003882, -0.048116, 1.051998]],
  'deuteranopia': [[0.367322, 0.860646, -0.227968],
                   [0.280085, 0.672501, 0.047413],
                   [-0.011820, 0.042940, 0.968881]],
};
/** CIEDE2000 at which two lines of two pixels are told apart at a glance. */
const LEAST_APART = 15;
/** The same for the paths of recordings and lines that have a dash, a mark or
 * another width besides. */
const LEAST_APART_FROM_LINKS = 12;
/** WCAG 2.2, 1.4.11. */
const LEAST_CONTRAST = 3;

/** What is drawn on one map and has to be told apart by its colour. */
const MAPS = {
  vehicle: ['path', 'closure', 'rejection', 'accepted', 'ambiguous',
            'uninformative', 'rejected-by-shape', 'rejected-by-gate',
            'ill-conditioned'],
  candidate: ['matched-path', 'query-path', 'path'],
  recordings: ['path', 'recording-1', 'recording-2', 'recording-3',
               'recording-4'],
};

const STYLE = readFileSync(
    join(ROOT, 'client/console/web/style.css'), 'utf8');

function coloursOf(theme) {
  const [light, dark] = STYLE.split(':root[data-theme=\'dark\']');
  const read = text => Object.fromEntries(
      [...text.slice(0, text.indexOf('}')).matchAll(
          /--([\w-]+):\s*(#[0-9a-f]{6});/g)].map(
          ([, name, colour]) => [name, colour]));
  return theme === 'light' ? read(light) : {...read(light), ...read(dark)};
}

function linear(colour) {
  return [1, 3, 5].map(i => {
    const value = parseInt(colour.slice(i, i + 2), 16) / 255;
    return value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4;
  });
}

const times = (matrix, vector) =>
    matrix.map(row => row.reduce((sum, m, i) => sum + m * vector[i], 0));

function labOf(colour, sight) {
  const seen = times(SIGHTS[sight], linear(colour))
                   .map(value => Math.min(1, Math.max(0, value)));
  const [x, y, z] = times([[0.4124564, 0.3575761, 0.1804375],
                           [0.2126729, 0.7151522, 0.0721750],
                           [0.0193339, 0.1191920, 0.9503041]], seen)
      .map((value, i) => value / [0.95047, 1, 1.08883][i])
      .map(t => t > 216 / 24389 ? Math.cbrt(t) : (24389 / 27 * t + 16) / 116);
  return [116 * y - 16, 500 * (x - y), 200 * (y - z)];
}

const radians = degrees => degrees * Math.PI / 180;

/** CIEDE2000. */
function apart([l1, a1, b1], [l2, a2, b2]) {
  const mean = (Math.hypot(a1, b1) + Math.hypot(a2, b2)) / 2;
  const g = (1 - Math.sqrt(mean ** 7 / (mean ** 7 + 25 ** 7))) / 2;
  const [c1, c2] = [Math.hypot(a1 * (1 + g), b1), Math.hypot(a2 * (1 + g), b2)];
  const hue = (a, b) =>
      (Math.atan2(b, a * (1 + g)) * 180 / Math.PI + 360) % 360;
  const [h1, h2] = [hue(a1, b1), hue(a2, b2)];
  const turn = c1 * c2 === 0 ? 0 : ((h2 - h1 + 540) % 360) - 180;
  const dh = 2 * Math.sqrt(c1 * c2) * Math.sin(radians(turn / 2));
  const [l, c] = [(l1 + l2) / 2, (c1 + c2) / 2];
  const h = c1 * c2 === 0 ? h1 + h2 : h1 + turn / 2;
  const t = 1 - 0.17 * Math.cos(radians(h - 30)) +
      0.24 * Math.cos(radians(2 * h)) + 0.32 * Math.cos(radians(3 * h + 6)) -
      0.2 * Math.cos(radians(4 * h - 63));
  const sl = 1 + 0.015 * (l - 50) ** 2 / Math.sqrt(20 + (l - 50) ** 2);
  const sc = 1 + 0.045 * c;
  const sh = 1 + 0.015 * c * t;
  const around = 30 * Math.exp(-((((h + 360) % 360 - 275) / 25) ** 2));
  const rt = -Math.sin(radians(2 * around)) * 2 *
      Math.sqrt(c ** 7 / (c ** 7 + 25 ** 7));
  return Math.sqrt(((l2 - l1) / sl) ** 2 + ((c2 - c1) / sc) ** 2 +
                   (dh / sh) ** 2 + rt * (c2 - c1) / sc * dh / sh);
}

function contrast(one, other) {
  const light = colour => times([[0.2126, 0.7152, 0.0722]], linear(colour))[0];
  const [dark, bright] = [light(one), light(other)].sort((a, b) => a - b);
  return (bright + 0.05) / (dark + 0.05);
}

test('distances are those of the published pairs', () => {
  // Sharma, Wu and Dalal 2005, pairs 1, 7 and 25.
  for (const [one, other, distance] of [
    [[50, 2.6772, -79.7751], [50, 0, -82.7485], 2.0425],
    [[50, 0, 0], [50, -1, 2], 2.3669],
    [[60.2574, -34.0099, 36.2677], [60.4626, -34.1751, 39.4387], 1.2644],
  ]) {
    assert.ok(Math.abs(apart(one, other) - distance) < 1e-4);
  }
});

for (const theme of ['light', 'dark']) {
  test(`lines of one map are told apart by all people, ${theme}`, () => {
    const colours = coloursOf(theme);
    for (const [map, names] of Object.entries(MAPS)) {
      for (const sight of Object.keys(SIGHTS)) {
        names.forEach((name, i) => names.slice(i + 1).forEach(other => {
          const distance = apart(labOf(colours[name], sight),
                                 labOf(colours[other], sight));
          assert.ok(distance >= LEAST_APART, `${map}, ${sight}: ${name} and ${
              other} are ${distance.toFixed(1)} apart`);
        }));
      }
    }
  });

  test(`recordings are told apart from links by all people, ${theme}`, () => {
    const colours = coloursOf(theme);
    for (const sight of Object.keys(SIGHTS)) {
      for (const name of MAPS.recordings.slice(1)) {
        for (const other of MAPS.vehicle) {
          const distance = apart(labOf(colours[name], sight),
                                 labOf(colours[other], sight));
          assert.ok(distance >= LEAST_APART_FROM_LINKS, `${sight}: ${
              name} and ${other} are ${distance.toFixed(1)} apart`);
        }
      }
    }
  });

  test(`lines stand out against the page, ${theme}`, () => {
    const colours = coloursOf(theme);
    for (const name of Object.values(MAPS).flat()) {
      const got = contrast(colours[name], colours.background);
      assert.ok(got >= LEAST_CONTRAST, `${name}: ${got.toFixed(2)}`);
    }
  });
}
