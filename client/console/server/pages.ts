import {readdirSync, readFileSync} from 'node:fs';
import type {IncomingMessage, ServerResponse} from 'node:http';
import {extname, join, relative, sep} from 'node:path';

import {routeOf} from '../shared/addresses.js';

const TYPES: Record<string, string> = {
  '.css': 'text/css; charset=utf-8',
  '.html': 'text/html; charset=utf-8',
  '.js': 'text/javascript; charset=utf-8',
  '.json': 'application/json',
  '.svg': 'image/svg+xml',
};

/** Sent with every answer. */
export const SECURITY_HEADERS: Record<string, string> = {
  'content-security-policy': [
    'default-src \'none\'', 'script-src \'self\'', 'style-src \'self\'',
    'img-src \'self\' blob:', 'connect-src \'self\'', 'worker-src \'self\'',
    'base-uri \'none\'', 'form-action \'none\'', 'frame-ancestors \'none\'',
  ].join('; '),
  'cross-origin-opener-policy': 'same-origin',
  'cross-origin-resource-policy': 'same-origin',
  'referrer-policy': 'no-referrer',
  'x-content-type-options': 'nosniff',
};

interface Page {
  body: Buffer;
  type: string;
  cache: string;
}

/** Answers with the files of a folder, which are read once, and with its
 * index.html at the addresses of views. */
export class Pages {
  private readonly pages = new Map<string, Page>();

  constructor(folder: string) {
    for (const entry of readdirSync(folder, {withFileTypes: true,
                                             recursive: true})) {
      if (!entry.isFile()) continue;
      const path = join(entry.parentPath ?? entry.path, entry.name);
      const address = '/' + relative(folder, path).split(sep).join('/');
      this.pages.set(address, {
        body: readFileSync(path),
        type: TYPES[extname(path)] ?? 'application/octet-stream',
        // The names of assets hold a hash of their content.
        cache: address.startsWith('/assets/') ?
            'public, max-age=31536000, immutable' :
            'no-cache',
      });
    }
    if (!this.pages.has('/index.html')) {
      throw new Error(`${folder} has no index.html: npm run build makes it`);
    }
  }

  /** Answers at this address with a text of its own. */
  add(address: string, text: string): void {
    this.pages.set(address, {body: Buffer.from(text),
                             type: TYPES[extname(address)],
                             cache: 'no-cache'});
  }

  answer(request: IncomingMessage, response: ServerResponse): void {
    const path = (request.url ?? '/').split('?')[0];
    const isView = routeOf(path).view !== 'none';
    const page = this.pages.get(isView ? '/index.html' : path);
    if (!page) {
      response.writeHead(404, {'content-type': 'text/plain'});
      response.end('Not found\n');
      return;
    }
    if (request.method !== 'GET' && request.method !== 'HEAD') {
      response.writeHead(405, {'allow': 'GET, HEAD'});
      response.end();
      return;
    }
    response.writeHead(200, {
      'content-type': page.type,
      'content-length': page.body.length,
      'cache-control': page.cache,
    });
    response.end(request.method === 'HEAD' ? undefined : page.body);
  }
}
