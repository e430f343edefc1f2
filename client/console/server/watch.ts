import {setTimeout as sleep} from 'node:timers/promises';

import {Code, ConnectError, createClient, type Transport} from
    '@connectrpc/connect';

import {Health} from '../gen/grpc/health/v1/health_pb.js';
import {isAway} from '../shared/error_info.js';
import type {Log} from './log.js';
import type {Telemetry} from './telemetry.js';

const INTERVAL_MILLISECONDS = 1000;
const DEADLINE_MILLISECONDS = 2000;
interface Absence {
  since: Date;
  message: string;
}

/**
 * Asks one server each second whether it is there, by the health service, which
 * is open to all and which it does not log. A server that stands still, or that
 * a cut network hides, keeps connections open and silent: calls that wait for it
 * are ended then, and later ones refused, so that people learn of it within
 * three seconds rather than from the deadlines of their calls.
 */
export class Watch {
  private absence: Absence|undefined;
  private isSilent = false;
  /** When it last answered anything at all. */
  private heard = performance.now();

  /** `cut` ends the connection to it, and all calls on it. */
  constructor(readonly address: string, private readonly transport: Transport,
              private readonly cut: (reason: ConnectError) => void,
              private readonly log: Log,
              private readonly telemetry: Telemetry) {}

  /** Goes on until the process ends. */
  async run(): Promise<never> {
    for (;;) {
      await this.look();
      await sleep(INTERVAL_MILLISECONDS, undefined, {ref: false});
    }
  }

  /** An answer to any call shows that it is there, however busy it is. */
  hear(): void {
    this.heard = performance.now();
  }

  get isUp(): boolean {
    return this.absence === undefined;
  }

  /** Throws while it is known not to answer. Where it refuses connections, each
   * call finds out by itself, as fast. */
  check(): void {
    if (this.absence && this.isSilent) throw this.error(this.absence);
  }

  /** Why it is not there; '' if it is. */
  get complaint(): string {
    return this.absence?.message ?? '';
  }

  private error({since, message}: Absence): ConnectError {
    return new ConnectError(
        `${this.address} does not answer since ${since.toISOString()}: ` +
        message, Code.Unavailable);
  }

  private async look(): Promise<void> {
    const began = performance.now();
    try {
      await createClient(Health, this.transport).check(
          {}, {timeoutMs: DEADLINE_MILLISECONDS});
    } catch (error) {
      const {code, rawMessage} = ConnectError.from(error);
      if (isAway(error) && this.heard < began) {
        this.lose(rawMessage, code === Code.DeadlineExceeded);
        return;
      }
    }
    this.find();
  }

  private lose(message: string, silent: boolean): void {
    this.isSilent = silent;
    if (!this.absence) {
      this.absence = {since: new Date(), message};
      this.log.write('warning', 'server_away', {server: this.address, message});
    }
    this.telemetry.serverIs(this.address, false);
    if (silent) this.cut(this.error(this.absence));
  }

  private find(): void {
    this.hear();
    this.telemetry.serverIs(this.address, true);
    if (!this.absence) return;
    this.log.write('info', 'server_back', {
      server: this.address,
      away_ms: Date.now() - this.absence.since.getTime(),
    });
    this.absence = undefined;
  }
}
