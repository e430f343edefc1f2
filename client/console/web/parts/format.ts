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

/** The name of a value of an enumeration, such as ACTIVE, in words. */
export function words(name: string): string {
  return name.toLowerCase().replaceAll('_', ' ');
}
