// Numbers and times as people read them.
import {timestampDate} from '@bufbuild/protobuf/wkt';
import type {Timestamp} from '@bufbuild/protobuf/wkt';

const whole = new Intl.NumberFormat('en', {maximumFractionDigits: 0});

export function count(value: number|bigint): string {
  return whole.format(value);
}

export function fixed(value: number, digits: number): string {
  return value.toLocaleString(
      'en', {minimumFractionDigits: digits, maximumFractionDigits: digits});
}

export function length(meters: number): string {
  if (Math.abs(meters) >= 10_000) return `${fixed(meters / 1000, 1)} km`;
  if (Math.abs(meters) >= 1000) return `${fixed(meters / 1000, 2)} km`;
  return `${Number.isInteger(meters) ? meters : fixed(meters, 1)} m`;
}

/** A probability: near 0 and 1 what is missing is what matters. */
export function probability(value: number): string {
  if (value > 0 && value < 0.001) return '< 0.001';
  if (value < 1 && value > 0.999) return '> 0.999';
  return fixed(value, 3);
}

export function degrees(radians: number): string {
  return `${fixed(radians * 180 / Math.PI, 1)}°`;
}

export function bytes(value: number|bigint): string {
  const units = ['B', 'KiB', 'MiB', 'GiB'];
  let amount = Number(value);
  let unit = 0;
  while (amount >= 1024 && unit + 1 < units.length) {
    amount /= 1024;
    ++unit;
  }
  return `${unit === 0 ? amount : fixed(amount, 1)} ${units[unit]}`;
}

export function time(stamp: Timestamp|undefined): string {
  return stamp ? timestampDate(stamp).toISOString()
                     .replace('T', ' ').replace(/\.\d+Z$/, ' UTC') :
                 '';
}

/** Milliseconds since 1970 as a time of UTC with its milliseconds; '' for
 * NaN. */
export function instant(millisecondsSince1970: number): string {
  return Number.isNaN(millisecondsSince1970) ? '' :
      new Date(millisecondsSince1970).toISOString()
          .replace('T', ' ').replace('Z', ' UTC');
}

/** A time of today, or a day with its time, in the reader's own zone. */
export function moment(millisecondsSince1970: number): string {
  const date = new Date(millisecondsSince1970);
  return date.toDateString() === new Date().toDateString() ?
      date.toLocaleTimeString() : date.toLocaleString();
}

/** The name of a value of an enumeration, such as ACTIVE, in words. */
export function words(name: string): string {
  return name.toLowerCase().replaceAll('_', ' ');
}

/** A time that something took. */
export function duration(seconds: number): string {
  if (seconds >= 100) return `${fixed(seconds, 0)} s`;
  if (seconds >= 1) return `${fixed(seconds, 2)} s`;
  return `${fixed(1000 * seconds, seconds >= 0.1 ? 0 : 2)} ms`;
}

/** A share of something that can be used up. */
export function percent(share: number): string {
  if (share > 0 && share < 0.0001) return '< 0.01 %';
  return `${fixed(100 * share, share < 0.1 ? 2 : 0)} %`;
}

/** How long ago, or ahead, in the largest unit that fits. */
export function age(seconds: number): string {
  for (const [unit, size] of [['days', 86_400], ['hours', 3600],
                              ['minutes', 60]] as const) {
    if (seconds >= 2 * size) return `${count(Math.floor(seconds / size))} ${
        unit}`;
  }
  return `${count(Math.round(seconds))} s`;
}

/** So many a second. */
export function rate(perSecond: number): string {
  return `${fixed(perSecond, perSecond < 10 ? 2 : 0)}/s`;
}
