// Readings of the metrics of revisitd, and the numbers that follow from two of
// them.
import type {MetricSample} from '../../server/exposition.js';
import type {Scrape} from '../../server/scrape.js';

export type Labels = Record<string, string>;

/** A quantile of a histogram, in the unit of its values. */
export interface Quantile {
  value: number;
  /** It lies beyond the last bound, which `value` is. */
  isBeyond: boolean;
}

/** One reading of all metrics. */
export class Reading {
  /** Milliseconds since 1970. */
  readonly time: number;
  private readonly samples = new Map<string, MetricSample[]>();

  constructor({time, samples}: Scrape) {
    this.time = time;
    for (const sample of samples) {
      const known = this.samples.get(sample.name);
      if (known) {
        known.push(sample);
      } else {
        this.samples.set(sample.name, [sample]);
      }
    }
  }

  private matching(name: string, labels: Labels): MetricSample[] {
    const wanted = Object.entries(labels);
    return (this.samples.get(name) ?? []).filter(
        sample => wanted.every(
            ([label, value]) => sample.labels[label] === value));
  }

  /** The sum of the samples with these labels; undefined if there are none. */
  value(name: string, labels: Labels = {}): number|undefined {
    const found = this.matching(name, labels);
    return found.length === 0 ? undefined :
        found.reduce((sum, {value}) => sum + (value ?? 0), 0);
  }

  /** Sums for each value of a label, by that value. */
  by(name: string, label: string): Map<string, number> {
    const sums = new Map<string, number>();
    for (const {labels, value} of this.matching(name, {})) {
      const key = labels[label] ?? '';
      sums.set(key, (sums.get(key) ?? 0) + (value ?? 0));
    }
    return sums;
  }

  /** How many values of a histogram are at most each bound, by that bound. */
  buckets(name: string): Map<number, number> {
    const counts = new Map<number, number>();
    for (const [bound, sum] of this.by(`${name}_bucket`, 'le')) {
      counts.set(bound === '+Inf' ? Infinity : Number(bound), sum);
    }
    return counts;
  }
}

/** Numbers of one server, or of several together. Counters and histograms are
 * compared with those of `seconds` ago, and say nothing if that is 0. */
export interface Measures {
  /** Milliseconds since 1970 of the latest of them. */
  readonly time: number;
  readonly seconds: number;
  /** The sum of the samples with these labels; undefined if there are none. */
  value(name: string, labels?: Labels): number|undefined;
  /** Sums for each value of a label, by that value. */
  by(name: string, label: string): Map<string, number>;
  /** How often a second a counter went up; undefined if there is none. */
  rate(name: string, labels?: Labels): number|undefined;
  /** How often a second, by the values of a label. */
  ratesBy(name: string, label: string): Map<string, number>;
  /** How many new values of a histogram a second are at most each bound, by
   * that bound. */
  bucketRates(name: string): Map<number, number>;
}

/** The quantile of a histogram's new values, linear within its bucket;
 * undefined if there are none. */
export function quantile(measures: Measures, name: string, share: number):
    Quantile|undefined {
  const buckets =
      [...measures.bucketRates(name)].sort(([a], [b]) => a - b);
  const all = buckets.at(-1)?.[1] ?? 0;
  if (all <= 0) return undefined;
  let [least, under] = [0, 0];
  for (const [bound, sum] of buckets) {
    if (sum >= share * all && sum > under) {
      if (bound === Infinity) return {value: least, isBeyond: true};
      return {
        value: least + (bound - least) * (share * all - under) / (sum - under),
        isBeyond: false,
      };
    }
    [least, under] = [bound, sum];
  }
  return undefined;
}

/** The time between a reading and a later one of the same process, or none
 * between a reading and itself. */
export class Interval implements Measures {
  constructor(private readonly before: Reading, readonly now: Reading) {}

  get time(): number {
    return this.now.time;
  }

  get seconds(): number {
    return (this.now.time - this.before.time) / 1000;
  }

  value(name: string, labels: Labels = {}): number|undefined {
    return this.now.value(name, labels);
  }

  by(name: string, label: string): Map<string, number> {
    return this.now.by(name, label);
  }

  rate(name: string, labels: Labels = {}): number|undefined {
    const now = this.now.value(name, labels);
    if (now === undefined || this.seconds <= 0) return undefined;
    return (now - (this.before.value(name, labels) ?? 0)) / this.seconds;
  }

  ratesBy(name: string, label: string): Map<string, number> {
    return this.rates(this.now.by(name, label), this.before.by(name, label));
  }

  bucketRates(name: string): Map<number, number> {
    return this.rates(this.now.buckets(name), this.before.buckets(name));
  }

  private rates<Key>(now: Map<Key, number>, before: Map<Key, number>):
      Map<Key, number> {
    if (this.seconds <= 0) return new Map();
    return new Map([...now].map(
        ([key, sum]) => [key, (sum - (before.get(key) ?? 0)) / this.seconds]));
  }
}
