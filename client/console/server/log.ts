export const LOG_FORMATS = ['text', 'json'] as const;
export type LogFormat = typeof LOG_FORMATS[number];
export const LOG_LEVELS =
    ['debug', 'info', 'warning', 'error', 'off'] as const;
export type LogLevel = typeof LOG_LEVELS[number];

export type LogFields = Record<string, string|number|undefined>;

/** Text mode shows such a text without quotes. */
const BARE = /^[A-Za-z0-9._:/@+-]+$/;

function textOf(value: string|number): string {
  return typeof value === 'string' && BARE.test(value) ?
      value : JSON.stringify(value);
}

/**
 * Writes one line for each event to standard error, in the forms of revisitd's
 * log:
 *   2026-01-31T12:00:00.000Z info call method=GetVehicle code=OK
 *   {"time":"2026-01-31T12:00:00.000Z","level":"info","event":"call",...}
 * Fields that are undefined or empty are left out.
 */
export class Log {
  private readonly least: number;

  constructor(private readonly format: LogFormat, level: LogLevel) {
    this.least = LOG_LEVELS.indexOf(level);
  }

  write(level: Exclude<LogLevel, 'off'>, event: string,
        fields: LogFields = {}): void {
    if (LOG_LEVELS.indexOf(level) < this.least) return;
    const time = new Date().toISOString();
    const told = Object.entries(fields).filter(
        (entry): entry is [string, string|number] =>
            entry[1] !== undefined && entry[1] !== '');
    process.stderr.write((this.format === 'json' ?
        JSON.stringify({time, level, event, ...Object.fromEntries(told)}) :
        [time, level, event, ...told.map(
            ([key, value]) => `${key}=${textOf(value)}`)].join(' ')) + '\n');
  }
}
