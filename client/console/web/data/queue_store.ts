// The queue as the page knows it, kept up to date by a watch while it is in view.
import {Code, ConnectError} from '@connectrpc/connect';
import {batch, computed, signal} from '@preact/signals';

import {CandidateCause, CandidateState, type Check} from
    '../../gen/revisit/v1/check_pb.js';
import {ListChecksOrder} from
    '../../gen/revisit/v1/pose_graph_service_pb.js';
import {StoredChecks, type Vehicle} from '../../gen/revisit/v1/vehicle_pb.js';
import {allPages, messageOf, repeat, service} from './client.js';
import {type Deed, VERBS} from './decisions.js';
import {isOpen, otherVehicleOf, Queue, type Waiting} from './queue.js';
import {decideAbout, undoDeed} from './queue_decisions.js';
import {asDecided, deeds, isBusy, lastDecision, nameOf, pairOfWaiting,
        type QueueDeed, readOnly, subjectOf} from './queue_deeds.js';

/** At most so many are listed: of more, vehicle and probability choose. */
export const MOST_WAITING = 2000;
/** A check takes some seven kilobytes in a list. */
const CHECKS_A_PAGE = 250;
const VEHICLES_A_PAGE = 1000;
const VEHICLES_MILLISECONDS = 5000;
const RETRY_MILLISECONDS = 1000;
/** The server tells something each ten seconds or so. Where nothing comes for so
 * long, the watch goes on from its cursor by another connection. */
const SILENT_MILLISECONDS = 30_000;
/** What a refusal of these codes was about does not change within a second. */
const LASTING = new Set([Code.Unauthenticated, Code.PermissionDenied,
                         Code.NotFound, Code.Unimplemented,
                         Code.InvalidArgument]);
const LASTING_RETRY_MILLISECONDS = 10_000;
/** How long after a decision the values are read again, and how often at most:
 * second searches follow it within some seconds. */
const RENEW_MILLISECONDS = 2000;
const RENEW_INTERVAL_MILLISECONDS = 10_000;
/** What the values of other candidates rest on has changed with these. */
const CHANGE_VALUES = new Set([CandidateCause.LOOP_CLOSURE,
                               CandidateCause.DELETION,
                               CandidateCause.SEARCH]);
const PUBLISH_MILLISECONDS = 50;
const SWEEP_MILLISECONDS = 250;

export interface QueueFilter {
  /** Id of a vehicle; undefined for all. */
  vehicle: string|undefined;
  leastProbability: number;
  /** Whether the most valuable come first: then values are renewed as decisions
   * change them. */
  byValue: boolean;
}

const DONE: Record<Deed['act'], string> = {
  confirm: 'Confirmed', uphold: 'Upheld the loop closure of',
  reject: 'Rejected', undo: 'Undone: the decision about',
};

export class QueueStore {
  private readonly listed = signal<readonly Waiting[]|undefined>(undefined);
  /** Undefined until the first list is here. */
  readonly waiting = computed(
      () => this.listed.value && asDecided(this.listed.value));
  /** Whether more are open than are shown. */
  readonly isCut = signal(false);
  /** Whether what changes is told now. */
  readonly isLive = signal(false);
  readonly error = signal<string|undefined>(undefined);
  /** Those whose checks are stored. */
  readonly vehicles = signal<readonly Vehicle[]>([]);
  private queue = new Queue(MOST_WAITING);
  private cursor = '';
  private filter: QueueFilter = {vehicle: undefined, leastProbability: 0,
                                 byValue: false};
  /** When the last list was asked for, and the one that will be. */
  private listedAt = 0;
  private renewing: ReturnType<typeof setTimeout>|undefined;
  private run = new AbortController();
  private sweeping: ReturnType<typeof setInterval>|undefined;
  private isPublishing = false;
  private readonly endVehicles =
      repeat(VEHICLES_MILLISECONDS, () => this.refreshVehicles());
  /** A page out of view takes no connection, of which a browser has but a few. */
  private readonly onVisibility = () => {
    if (document.hidden) {
      this.run.abort();
    } else {
      this.start();
    }
  };

  constructor() {
    document.addEventListener('visibilitychange', this.onVisibility);
  }

  close(): void {
    this.run.abort();
    this.endVehicles();
    clearInterval(this.sweeping);
    clearTimeout(this.renewing);
    document.removeEventListener('visibilitychange', this.onVisibility);
  }

  /** Shows those that match, from now on. */
  show(filter: QueueFilter): void {
    this.filter = filter;
    this.queue = new Queue(MOST_WAITING);
    this.cursor = '';
    this.listed.value = undefined;
    this.start();
  }

  private start(): void {
    this.run.abort();
    clearTimeout(this.renewing);
    this.renewing = undefined;
    this.isLive.value = false;
    this.run = new AbortController();
    if (!document.hidden) void this.goOn(this.run.signal);
  }

  private get wanted() {
    const {vehicle, leastProbability} = this.filter;
    return {vehicles: vehicle ? [`vehicles/${vehicle}`] : [], leastProbability};
  }

  /** Lists and watches until it is aborted, over all breaks. */
  private async goOn(signal: AbortSignal): Promise<void> {
    while (!signal.aborted) {
      let pause = RETRY_MILLISECONDS;
      try {
        if (this.cursor === '') await this.list(signal);
        await this.watch(signal);
      } catch (error) {
        if (signal.aborted) return;
        const {code} = ConnectError.from(error);
        if (code === Code.OutOfRange) {
          // Events behind the cursor are kept no longer, or the store is another.
          this.cursor = '';
          pause = 0;
        } else if (code !== Code.Canceled) {
          this.error.value = messageOf(error);
          if (LASTING.has(code)) pause = LASTING_RETRY_MILLISECONDS;
        }
      }
      if (signal.aborted) return;
      this.isLive.value = false;
      await new Promise(done => setTimeout(done, pause));
    }
  }

  private async list(signal: AbortSignal): Promise<void> {
    const {checks, cursor, isCut} = await this.readList(signal);
    if (signal.aborted) return;
    this.queue.begin(checks, this.wanted.leastProbability, isCut);
    this.cursor = cursor;
    this.error.value = undefined;
    this.publishNow();
  }

  private async readList(signal: AbortSignal):
      Promise<{checks: Check[], cursor: string, isCut: boolean}> {
    const {wanted} = this;
    const {vehicle, byValue} = this.filter;
    this.listedAt = Date.now();
    const checks: Check[] = [];
    let [cursor, pageToken, count] = ['', '', 0];
    do {
      const page = await service.listChecks({
        // The server orders the checks of one vehicle alone by value.
        parent: `vehicles/${byValue && vehicle || '-'}`,
        order: byValue && vehicle ? ListChecksOrder.BY_VALUE :
                                    ListChecksOrder.BY_TIME,
        pageSize: CHECKS_A_PAGE, pageToken,
        filter: {...wanted, states: [CandidateState.OPEN]},
      }, {signal});
      if (pageToken === '') cursor = page.watchCursor;
      checks.push(...page.checks);
      count += page.checks.length;
      pageToken = page.nextPageToken;
    } while (pageToken !== '' && count < MOST_WAITING);
    return {checks, cursor, isCut: pageToken !== ''};
  }

  /** Reads the list again some time after a decision: it changes the values of
   * other candidates, of which no event tells. */
  private renewLater(): void {
    if (!this.filter.byValue || this.renewing !== undefined) return;
    const {signal} = this.run;
    const wait = Math.max(RENEW_MILLISECONDS, this.listedAt +
        RENEW_INTERVAL_MILLISECONDS - Date.now());
    this.renewing = setTimeout(async () => {
      try {
        const {checks} = await this.readList(signal);
        if (signal.aborted) return;
        this.queue.renew(checks);
        this.publishNow();
      } catch {
        // The watch tells what is wrong, if that lasts.
      } finally {
        this.renewing = undefined;
      }
    }, wait);
  }

  private async watch(signal: AbortSignal): Promise<void> {
    const silence = new AbortController();
    const end = () => silence.abort();
    signal.addEventListener('abort', end);
    let timer = setTimeout(end, SILENT_MILLISECONDS);
    try {
      const told = service.watchCandidates(
          {filter: this.wanted, cursor: this.cursor},
          {signal: silence.signal, timeoutMs: 0});
      for await (const {cursor, event} of told) {
        if (signal.aborted) return;
        clearTimeout(timer);
        timer = setTimeout(end, SILENT_MILLISECONDS);
        if (event.case === 'candidate') {
          this.queue.take(event.value, Date.now());
          if (CHANGE_VALUES.has(event.value.candidate!.cause)) {
            this.renewLater();
          }
          this.publish();
        } else if (event.case === 'vehicleDeleted') {
          this.queue.drop(event.value.vehicleUid);
          this.publish();
        }
        this.cursor = cursor;
        batch(() => {
          this.isLive.value = true;
          this.error.value = undefined;
        });
        if (this.queue.isCut && this.queue.openCount < MOST_WAITING / 2) {
          // There is room for those that were left out.
          this.cursor = '';
          return;
        }
      }
    } finally {
      clearTimeout(timer);
      signal.removeEventListener('abort', end);
      end();
    }
  }

  /** Many events that come at once are shown at once. */
  private publish(): void {
    if (this.isPublishing) return;
    this.isPublishing = true;
    setTimeout(() => {
      this.isPublishing = false;
      this.publishNow();
    }, PUBLISH_MILLISECONDS);
  }

  private publishNow(): void {
    const isFading = this.queue.sweep(Date.now());
    batch(() => {
      this.listed.value = [...this.queue.values];
      this.isCut.value = this.queue.isCut;
    });
    if (isFading) {
      this.sweeping ??= setInterval(() => this.publishNow(),
                                    SWEEP_MILLISECONDS);
    } else {
      clearInterval(this.sweeping);
      this.sweeping = undefined;
    }
  }

  private async refreshVehicles(): Promise<void> {
    const all = await allPages(
        pageToken => service.listVehicles(
            {pageToken, pageSize: VEHICLES_A_PAGE}),
        page => page.vehicles);
    this.vehicles.value = all.filter(
        ({settings}) => settings?.checks === StoredChecks.STORED);
  }

  /** Decides about a candidate as it was found. */
  decide(act: 'confirm'|'reject', candidate: Waiting): void {
    if (!isOpen(candidate) || isBusy(candidate.key) ||
        readOnly.value.has(subjectOf(candidate))) {
      return;
    }
    void this.perform(act, candidate, async () => {
      const ended = await decideAbout(act, candidate);
      if (otherVehicleOf(candidate) === undefined) {
        this.queue.settle(candidate.key, act === 'confirm' ?
            CandidateState.CONFIRMED : CandidateState.REJECTED, ended.made!,
            Date.now());
      }
      return ended;
    });
  }

  /** Deletes what the last decision of this page made, adds what it deleted, and
   * returns it, if there is one. */
  undo(): QueueDeed|undefined {
    const last = lastDecision();
    if (!last || isBusy(last.at)) return undefined;
    void this.perform('undo', last.candidate, async () => {
      await undoDeed(last);
      return {};
    }, last.made);
    return last;
  }

  private async perform(act: Deed['act'], candidate: Waiting,
                        work: () => Promise<Partial<QueueDeed>>,
                        made?: string): Promise<void> {
    const deed: QueueDeed = {
      id: deeds.value.length + 1, act, pair: pairOfWaiting(candidate),
      at: candidate.key, candidate, made, state: 'under way', text: '…',
      time: Date.now(),
    };
    deeds.value = [...deeds.value, deed];
    const end = (ended: Partial<QueueDeed>) => {
      deeds.value = deeds.value.map(
          other => other.id === deed.id ? {...deed, ...ended} : other);
    };
    const what = nameOf(candidate);
    try {
      const ended = await work();
      const text = `${DONE[ended.act ?? act]} ${what}.`;
      batch(() => {
        end({...ended, state: 'done', text});
        this.publishNow();
      });
    } catch (error) {
      if (act !== 'undo' &&
          ConnectError.from(error).code === Code.PermissionDenied) {
        readOnly.value = new Set([...readOnly.value, subjectOf(candidate)]);
      }
      end({state: 'failed',
           text: `${what} was not ${VERBS[act]}: ${messageOf(error)}`});
    }
  }
}
