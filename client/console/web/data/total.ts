// Adds up the numbers of several servers.
import type {Labels, Measures} from './readings.js';

function sum(values: Array<number|undefined>): number|undefined {
  const known = values.filter(value => value !== undefined);
  return known.length === 0 ? undefined : known.reduce((a, b) => a + b, 0);
}

function sumsByKey<Key>(maps: Array<Map<Key, number>>): Map<Key, number> {
  const sums = new Map<Key, number>();
  for (const [key, value] of maps.flatMap(map => [...map])) {
    sums.set(key, (sums.get(key) ?? 0) + value);
  }
  return sums;
}

/**
 * The sums over servers. Each counts since its own reading, so what is summed
 * are rates: a server that began a second ago counts as much as the others. A
 * sum is right for what each server has of its own, such as calls and vehicles
 * in memory, but not for shares, times, or the size of a store they share.
 */
export class Total implements Measures {
  /** There is a server at least. */
  constructor(private readonly parts: readonly Measures[]) {}

  get time(): number {
    return Math.max(...this.parts.map(({time}) => time));
  }

  get seconds(): number {
    return Math.max(...this.parts.map(({seconds}) => seconds));
  }

  value(name: string, labels: Labels = {}): number|undefined {
    return sum(this.parts.map(part => part.value(name, labels)));
  }

  by(name: string, label: string): Map<string, number> {
    return sumsByKey(this.parts.map(part => part.by(name, label)));
  }

  rate(name: string, labels: Labels = {}): number|undefined {
    return sum(this.parts.map(part => part.rate(name, labels)));
  }

  ratesBy(name: string, label: string): Map<string, number> {
    return sumsByKey(this.parts.map(part => part.ratesBy(name, label)));
  }

  /** Only at bounds that all servers have: of two versions with other buckets
   * the counts at other bounds would not be of all values. */
  bucketRates(name: string): Map<number, number> {
    const all = this.parts.map(part => part.bucketRates(name))
                    .filter(rates => rates.size > 0);
    return new Map([...sumsByKey(all)].filter(
        ([bound]) => all.every(rates => rates.has(bound))));
  }
}
