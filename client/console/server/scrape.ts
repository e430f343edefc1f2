import {setTimeout as sleep} from 'node:timers/promises';

import {type MetricSample, parseMetrics} from './exposition.js';

/** One reading of a server's metrics. */
export interface Scrape {
  /** Milliseconds since 1970 at which they were read. */
  time: number;
  samples: MetricSample[];
}

/** The page on which one server tells its metrics. */
export interface MetricsPage {
  /** Unique among the pages of a console. */
  name: string;
  url: string;
}

/** A server does not answer, or answers something else than metrics. */
export interface Silence {
  /** Milliseconds since 1970 at which it was first asked in vain. */
  since: number;
  message: string;
}

/** All that is known of one server at a time: its name alone until its first
 * answer or deadline. */
export interface ServerMetrics {
  name: string;
  /** The last reading, unless the server has not answered since. */
  scrape?: Scrape;
  silence?: Silence;
}

const MOST_BYTES = 4 << 20;
const DEADLINE_MILLISECONDS = 5000;
/** How long those who ask wait for a reading that has begun. */
const PATIENCE_MILLISECONDS = 250;
/** All who ask in the meantime share one reading. */
const FRESH_MILLISECONDS = 500;
/** After so long without a reading, the ones before say nothing of now. */
const FORGOTTEN_MILLISECONDS = 60_000;
const SHOWN = /^(revisit|process)_/;

async function readBounded(answer: Response): Promise<string> {
  const parts: Uint8Array[] = [];
  let bytes = 0;
  for await (const part of answer.body as unknown as
             AsyncIterable<Uint8Array>) {
    bytes += part.length;
    if (bytes > MOST_BYTES) {
      throw new Error(`more than ${MOST_BYTES} bytes of metrics`);
    }
    parts.push(part);
  }
  return Buffer.concat(parts).toString();
}

async function scrape(url: string): Promise<Scrape> {
  const answer = await fetch(url, {
    redirect: 'error',
    signal: AbortSignal.timeout(DEADLINE_MILLISECONDS),
  });
  if (answer.status !== 200) {
    await answer.body?.cancel();
    throw new Error(`it answers ${answer.status}`);
  }
  const samples = parseMetrics(await readBounded(answer));
  return {time: Date.now(),
          samples: samples.filter(({name}) => SHOWN.test(name))};
}

function messageOf(url: string, error: unknown): string {
  const {message, cause} = error as Error;
  const why = cause instanceof Error ? `: ${cause.message}` : '';
  return `No metrics from ${url}: ${message}${why}`;
}

/** Reads the metrics of one server whenever somebody asks for them. */
export class Scraper {
  private known: ServerMetrics;
  /** When the last reading was begun. */
  private begun = -Infinity;
  /** The reading that is on; it never fails. */
  private reading: Promise<void>|undefined;

  constructor(private readonly page: MetricsPage) {
    this.known = {name: page.name};
  }

  /** Begins a reading, unless one is on or has just been made, and waits for it
   * briefly: what was known before is returned while a server is slow to
   * answer, so that nobody waits for it to see the others. */
  async latest(): Promise<ServerMetrics> {
    const now = Date.now();
    const age = now - this.begun;
    if (!this.reading && age > FRESH_MILLISECONDS) {
      if (age > FORGOTTEN_MILLISECONDS) this.known = {name: this.page.name};
      this.begun = now;
      this.reading = this.read().finally(() => {
        this.reading = undefined;
      });
    }
    await Promise.race([this.reading, sleep(PATIENCE_MILLISECONDS)]);
    return this.known;
  }

  private async read(): Promise<void> {
    const {name, url} = this.page;
    try {
      this.known = {name, scrape: await scrape(url)};
    } catch (error) {
      this.known = {name, silence: {
        since: this.known.silence?.since ?? this.begun,
        message: messageOf(url, error),
      }};
    }
  }
}
