// Writes archives of map tiles (PMTiles, version 3), with pictures or vectors.
import {writeFileSync} from 'node:fs';
import {createRequire} from 'node:module';
import {join} from 'node:path';
import {deflateSync} from 'node:zlib';

import {ROOT} from './world.mjs';

// The libraries by which the console reads what is written here.
const library = createRequire(join(ROOT, 'client/console/web/main.tsx'));
const {zxyToTileId} = library('pmtiles');
const {default: Pbf} = await import(library.resolve('pbf'));

const HEAD_BYTES = 127;
const UNCOMPRESSED = 1;
const KINDS = {mvt: 1, png: 2};

function varints(numbers) {
  const bytes = [];
  for (let number of numbers) {
    while (number >= 128) {
      bytes.push(number % 128 + 128);
      number = Math.floor(number / 128);
    }
    bytes.push(number);
  }
  return Buffer.from(bytes);
}

/** Writes tiles {z, x, y, data} of kind 'png' or 'mvt'. */
export function writeArchive(path, kind, tiles, metadata = {}) {
  const sorted = tiles.map(tile => ({
    ...tile, id: zxyToTileId(tile.z, tile.x, tile.y),
  })).sort((a, b) => a.id - b.id);
  const offsets = [];
  let end = 0;
  for (const {data} of sorted) {
    offsets.push(end);
    end += data.length;
  }
  const directory = varints([
    sorted.length,
    ...sorted.map(({id}, i) => id - (i === 0 ? 0 : sorted[i - 1].id)),
    ...sorted.map(() => 1),
    ...sorted.map(({data}) => data.length),
    ...offsets.map(offset => offset + 1),
  ]);
  const description = Buffer.from(JSON.stringify(metadata));
  const head = Buffer.alloc(HEAD_BYTES);
  head.write('PMTiles', 0, 'latin1');
  head[7] = 3;
  const metadataStart = HEAD_BYTES + directory.length;
  const tileStart = metadataStart + description.length;
  [HEAD_BYTES, directory.length, metadataStart, description.length, tileStart,
   0, tileStart, end, sorted.length, sorted.length, sorted.length]
      .forEach((number, i) => head.writeBigUInt64LE(BigInt(number), 8 + 8 * i));
  head[96] = 1;
  head[97] = head[98] = UNCOMPRESSED;
  head[99] = KINDS[kind];
  const levels = sorted.map(({z}) => z);
  head[100] = Math.min(...levels);
  head[101] = Math.max(...levels);
  [-180e7, -85e7, 180e7, 85e7].forEach(
      (degrees, i) => head.writeInt32LE(degrees, 102 + 4 * i));
  writeFileSync(path, Buffer.concat([head, directory, description,
                                     ...sorted.map(({data}) => data)]));
}

function checksum(bytes) {
  let crc = ~0;
  for (const byte of bytes) {
    crc ^= byte;
    for (let k = 0; k < 8; ++k) crc = crc & 1 ? crc >>> 1 ^ 0xedb88320 :
                                                crc >>> 1;
  }
  return ~crc >>> 0;
}

function chunk(type, data) {
  const named = Buffer.concat([Buffer.from(type, 'latin1'), data]);
  const bytes = Buffer.alloc(8 + named.length);
  bytes.writeUInt32BE(data.length, 0);
  named.copy(bytes, 4);
  bytes.writeUInt32BE(checksum(named), 4 + named.length);
  return bytes;
}

/** A PNG of 256 by 256 pixels of one colour. */
export function picture([red, green, blue]) {
  const side = 256;
  const row = Buffer.concat([
    Buffer.from([0]),
    ...Array.from({length: side}, () => Buffer.from([red, green, blue])),
  ]);
  const head = Buffer.alloc(13);
  head.writeUInt32BE(side, 0);
  head.writeUInt32BE(side, 4);
  // Eight bits a colour, and three colours.
  head.set([8, 2, 0, 0, 0], 8);
  return Buffer.concat([
    Buffer.from([0x89, 0x50, 0x4e, 0x47, 0x0d, 0x0a, 0x1a, 0x0a]),
    chunk('IHDR', head),
    chunk('IDAT', deflateSync(Buffer.concat(Array(side).fill(row)))),
    chunk('IEND', Buffer.alloc(0)),
  ]);
}

const EXTENT = 4096;
const LINE_TO = 2;
const GEOMETRY = {line: 2, area: 3};

function zigzag(number) {
  return number << 1 ^ number >> 31;
}

function geometryOf(kind, points) {
  const steps = points.map(([x, y], i) => {
    const [px, py] = i === 0 ? [0, 0] : points[i - 1];
    return [zigzag(x - px), zigzag(y - py)];
  });
  return [1 | 1 << 3, ...steps[0],
          LINE_TO | (points.length - 1) << 3, ...steps.slice(1).flat(),
          ...kind === 'area' ? [7 | 1 << 3] : []];
}

/** A vector tile of features {layer, kind: 'line' or 'area', name, points}; the
 * name is the feature's `kind`, points are in 4096ths of the tile's side, and
 * those of areas run clockwise as seen on the map. */
export function vectors(features) {
  const tile = new Pbf();
  for (const {layer, kind, name, points} of features) {
    tile.writeMessage(3, (_, pbf) => {
      pbf.writeVarintField(15, 2);
      pbf.writeStringField(1, layer);
      pbf.writeMessage(2, (_feature, body) => {
        body.writePackedVarint(2, [0, 0]);
        body.writeVarintField(3, GEOMETRY[kind]);
        body.writePackedVarint(4, geometryOf(kind, points));
      }, null);
      pbf.writeStringField(3, 'kind');
      pbf.writeMessage(4, (_value, body) => body.writeStringField(1, name),
                       null);
      pbf.writeVarintField(5, EXTENT);
    }, null);
  }
  return Buffer.from(tile.finish());
}
