import {createServer, type Server} from 'node:http';

import type {Telemetry} from './telemetry.js';
import type {Watch} from './watch.js';

interface Answer {
  status: number;
  type: string;
  body: string;
}

function line(status: number, body: string): Answer {
  return {status, type: 'text/plain; charset=utf-8', body: `${body}\n`};
}

async function answerTo(path: string, watches: readonly Watch[],
                        telemetry: Telemetry): Promise<Answer> {
  switch (path) {
    case '/livez':
      return line(200, 'ok');
    case '/readyz':
      return watches.some(watch => watch.isUp) ?
          line(200, 'ok') :
          line(503, 'no revisitd: ' + watches.map(
              ({address, complaint}) => `${address}: ${complaint}`).join('; '));
    case '/metrics':
      return {status: 200, type: telemetry.contentType,
              body: await telemetry.text()};
    default:
      return line(404, 'Here are /livez, /readyz and /metrics.');
  }
}

/** Answers probes and Prometheus, on a port of its own as revisitd does: to
 * whoever reaches it. */
export function makeAdmin(watches: readonly Watch[], telemetry: Telemetry):
    Server {
  return createServer((request, response) => {
    if (request.method !== 'GET' && request.method !== 'HEAD') {
      response.writeHead(405, {'allow': 'GET, HEAD'}).end();
      return;
    }
    const path = (request.url ?? '/').split('?')[0];
    void answerTo(path, watches, telemetry).then(({status, type, body}) => {
      response.writeHead(status, {'content-type': type,
                                  'cache-control': 'no-store'});
      response.end(request.method === 'HEAD' ? undefined : body);
    });
  });
}
