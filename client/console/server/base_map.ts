import {closeSync, openSync, readSync, type Stats} from 'node:fs';
import type {IncomingMessage, ServerResponse} from 'node:http';
import {basename, dirname, resolve} from 'node:path';

import send from 'send';

/** Where the page finds the base map. */
export const BASE_MAP_PATH = '/base-map.pmtiles';

const MAGIC = 'PMTiles';
const VERSION = 3;

/** Throws if this file is no PMTiles archive that the page can read. */
function check(path: string): void {
  const head = Buffer.alloc(MAGIC.length + 1);
  const file = openSync(path, 'r');
  try {
    readSync(file, head, 0, head.length, 0);
  } finally {
    closeSync(file);
  }
  if (head.toString('latin1', 0, MAGIC.length) !== MAGIC ||
      head[MAGIC.length] !== VERSION) {
    throw new Error(`${path} is no PMTiles archive of version ${VERSION}`);
  }
}

/** Answers requests for parts of the user's own map. */
export class BaseMap {
  private readonly path: string;

  /** Throws if the file cannot be read, or is something else. */
  constructor(path: string) {
    check(path);
    this.path = resolve(path);
  }

  answer(request: IncomingMessage, response: ServerResponse): void {
    if (request.method !== 'GET' && request.method !== 'HEAD') {
      response.writeHead(405, {'allow': 'GET, HEAD'});
      response.end();
      return;
    }
    send(request, encodeURIComponent(basename(this.path)), {
      root: dirname(this.path), dotfiles: 'allow', index: false,
      cacheControl: false,
    }).on('headers', (headers: ServerResponse, _path: string, stat: Stats) => {
      // The archive's reader tells by a strong tag that the file is another one
      // now, whose directory it then reads anew.
      headers.setHeader('etag', `"${stat.ino.toString(36)}-${
          stat.size.toString(36)}-${stat.mtimeMs.toString(36)}"`);
      headers.setHeader('cache-control', 'no-cache');
      headers.setHeader('content-type', 'application/vnd.pmtiles');
    }).on('error', (error: {status?: number, headers?: object}) => {
      response.writeHead(error.status ?? 500, {
        'content-type': 'text/plain', ...error.headers,
      });
      response.end('No such part of a base map.\n');
    }).pipe(response);
  }
}
