// Everything of the console that wants candidates gets them here: by
// FindCandidates, one call for each pose that is asked about.
import {Code, ConnectError} from '@connectrpc/connect';
import {signal} from '@preact/signals';

import {type Candidate, type CandidateSet, Verdict} from
    '../../gen/revisit/v1/candidate_pb.js';
import type {Pair} from './decisions.js';
import {idle, messageOf, service} from './client.js';

/** All that is known of the candidates at one pose. */
export interface Answer {
  /** The pose that was asked about. */
  asked: number;
  set: CandidateSet|undefined;
  /** Why there is no newer answer. */
  error: string|undefined;
  /** Something has changed since, so that the answer may be another one now. */
  outdated: boolean;
  /** It is asked again without anybody's doing: a search failed that need not
   * fail again. */
  again: boolean;
}

/** A candidate with the pose that was asked about. */
export interface Found {
  asked: number;
  set: CandidateSet;
  candidate: Candidate;
}

const AT_A_TIME = 2;
const WAIT_MILLISECONDS = 1000;
const PASSING = new Set([Code.ResourceExhausted, Code.Unavailable, Code.Aborted,
                         Code.DeadlineExceeded, Code.Unknown]);

/** Address of a candidate among those of its vehicle. */
export function keyOf({asked, candidate}: Found): string {
  return `${asked}-${candidate.matched!.sequence}`;
}

export function pairOf({candidate}: Found): Pair {
  return {query: Number(candidate.query!.sequence),
          matched: Number(candidate.matched!.sequence)};
}

export function verdictName(verdict: Verdict): string {
  return Verdict[verdict].toLowerCase().replaceAll('_', ' ');
}

export class CandidateSource {
  /** By the pose that was asked about. */
  readonly answers = signal<ReadonlyMap<number, Answer>>(new Map());
  private wanted: number[] = [];
  /** Those of `wanted` whose answer has to be of now. */
  private fresh = new Set<number>();
  private readonly asking = new Map<number, number>();
  private generation = 0;
  private closed = false;
  private publishing = false;
  private readonly known = new Map<number, Answer>();

  private readonly stopWaiting: () => void;

  constructor(private readonly vehicle: string) {
    // Searches that were wanted while nobody looked begin once somebody is back.
    this.stopWaiting = idle.subscribe(() => this.proceed());
  }

  /** Asks about these poses, the most urgent first, and about no others any
   * more. Poses whose answer is known are not asked about again, but for
   * `current` once its answer is outdated. */
  want(poses: readonly number[], current?: number): void {
    this.wanted = [...poses];
    this.fresh = new Set(current === undefined ? [] : [current]);
    this.proceed();
  }

  /** After a loop closure, a rejection, new settings or revised poses the
   * answers may be others. They are asked for again where somebody wants to
   * know: hundreds of searches a decision would be too many. */
  outdate(): void {
    ++this.generation;
    for (const [pose, answer] of this.known) {
      this.known.set(pose, {...answer, outdated: true});
    }
    this.publish();
    this.proceed();
  }

  /** Asks again about all that is wanted and outdated. */
  askAnew(): void {
    this.fresh = new Set(this.wanted);
    this.proceed();
  }

  close(): void {
    this.closed = true;
    this.stopWaiting();
    this.wanted = [];
  }

  private proceed(): void {
    if (idle.value) return;
    for (const pose of this.wanted) {
      if (this.asking.size >= AT_A_TIME) return;
      const answer = this.known.get(pose);
      const isDue = !answer || answer.again ||
          (answer.outdated && this.fresh.has(pose));
      if (isDue && !this.asking.has(pose)) void this.ask(pose);
    }
  }

  private async ask(asked: number): Promise<void> {
    const {generation} = this;
    this.asking.set(asked, generation);
    let answer: Answer = {asked, set: undefined, error: undefined,
                          outdated: false, again: false};
    try {
      const {candidates} = await service.findCandidates({
        vehicle: this.vehicle,
        sequence: BigInt(asked),
        options: {includeAlignedPath: true},
      });
      answer.set = candidates;
    } catch (error) {
      const passing = PASSING.has(ConnectError.from(error).code);
      answer = {...answer, set: this.known.get(asked)?.set,
                error: messageOf(error), outdated: passing, again: passing};
      if (passing) {
        await new Promise(done => setTimeout(done, WAIT_MILLISECONDS));
      }
    }
    answer.outdated ||= generation !== this.generation;
    this.asking.delete(asked);
    if (this.closed) return;
    this.known.set(asked, answer);
    this.publish();
    this.proceed();
  }

  /** Shows what is known, at most once a frame. */
  private publish(): void {
    if (this.publishing) return;
    this.publishing = true;
    setTimeout(() => {
      this.publishing = false;
      this.answers.value = new Map(this.known);
    }, 50);
  }
}

/** All candidates of these answers, by pose and rank. */
export function allFound(answers: ReadonlyMap<number, Answer>): Found[] {
  const poses = [...answers.keys()].sort((a, b) => a - b);
  return poses.flatMap(asked => {
    const {set} = answers.get(asked)!;
    return (set?.candidates ?? [])
        .map(candidate => ({asked, set: set!, candidate}));
  });
}
