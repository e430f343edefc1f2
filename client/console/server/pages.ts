import {existsSync, readdirSync, readFileSync} from 'node:fs';
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

/** Codings that browsers may take, the best first, with the ending of the file
 * that the build leaves beside the one that it compresses. */
const CODINGS = [['br', '.br'], ['gzip', '.gz']] as const;

interface Page {
  body: Buffer;
  type: string;
  cache: string;
  /** The body in other codings, by their names in HTTP. */
  coded: Map<string, Buffer>;
}

/** Whether a header Accept-Encoding lets a coding in; no word on it does not. */
function takes(accepted: string, coding: string): boolean {
  return accepted.split(',').some(part => {
    const [name, ...parameters] = part.split(';').map(text => text.trim());
    return name.toLowerCase() === coding &&
        !parameters.some(text => /^q=0(\.0*)?$/.test(text));
  });
}

/** Answers with the files of a folder, which are read once, and with its
 * index.html at the addresses of views. They are the same for everybody and
 * hold no secret, so that their compressed size tells nobody anything. */
export class Pages {
  private readonly pages = new Map<string, Page>();

  constructor(folder: string) {
    for (const entry of readdirSync(folder, {withFileTypes: true,
                                             recursive: true})) {
      if (!entry.isFile() || /\.(br|gz)$/.test(entry.name)) continue;
      const path = join(entry.parentPath ?? entry.path, entry.name);
      const address = '/' + relative(folder, path).split(sep).join('/');
      this.pages.set(address, {
        body: readFileSync(path),
        type: TYPES[extname(path)] ?? 'application/octet-stream',
        // The names of assets hold a hash of their content.
        cache: address.startsWith('/assets/') ?
            'public, max-age=31536000, immutable' :
            'no-cache',
        coded: new Map(CODINGS.flatMap(
            ([coding, ending]): Array<[string, Buffer]> =>
                existsSync(path + ending) ?
                [[coding, readFileSync(path + ending)]] : [])),
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
                             cache: 'no-cache', coded: new Map()});
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
    const accepted = String(request.headers['accept-encoding'] ?? '');
    const [coding] = CODINGS.find(
        ([name]) => page.coded.has(name) && takes(accepted, name)) ?? [];
    const body = coding === undefined ? page.body : page.coded.get(coding)!;
    response.writeHead(200, {
      'content-type': page.type,
      'content-length': body.length,
      'cache-control': page.cache,
      ...page.coded.size === 0 ? {} : {'vary': 'accept-encoding'},
      ...coding === undefined ? {} : {'content-encoding': coding},
    });
    response.end(request.method === 'HEAD' ? undefined : body);
  }
}
