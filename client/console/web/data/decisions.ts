// Decisions about a vehicle's pairs of poses, whoever made them, and the notes and
// outcomes of this page, each bound to the pair that it is about.
import {timestampMs} from '@bufbuild/protobuf/wkt';
import {batch, computed, signal} from '@preact/signals';

import type {DeletedPosePair, LoopClosure, RejectedCandidate} from
    '../../gen/revisit/v1/loop_closure_pb.js';
import {allPages, messageOf, service} from './client.js';

const PAGE_SIZE = 1000;
/** The most that the server puts on a page. */
const UNDONE_PAGE_SIZE = 500;

/** Two poses, by their sequences: the query is the later one. */
export interface Pair {
  query: number;
  matched: number;
}

export function keyOfPair({query, matched}: Pair): string {
  return `${query}-${matched}`;
}

/** A loop closure or a rejected candidate. */
export interface Decision extends Pair {
  kind: 'confirmed'|'rejected';
  /** The resource name. */
  name: string;
  note: string;
  /** Milliseconds since 1970. */
  time: number;
  /** Who made it, as the server knows its callers; empty if it does not. */
  by: string;
}

/** A decision that was undone, as it was. */
export interface Undone extends Decision {
  /** The resource name of the deletion: that of the decision may be another
   * one's by now. */
  deletion: string;
  /** Milliseconds since 1970. */
  undoneTime: number;
  /** Who undid it, as `by`. */
  undoneBy: string;
}

/** Something that was done in this page. */
export interface Deed {
  /** Its number among those of the page. */
  id: number;
  act: 'confirm'|'uphold'|'reject'|'undo';
  /** The pair that was decided about. */
  pair: Pair;
  /** Key of the pair that was shown then: there the outcome is told. */
  at: string;
  state: 'under way'|'done'|'failed';
  /** The outcome for people. */
  text: string;
  /** Milliseconds since 1970 at which it was begun. */
  time: number;
  /** Resource name of what was made. */
  made?: string;
}

/** What a deed does, as people say that it was done. */
export const VERBS: Record<Deed['act'], string> = {
  confirm: 'confirmed', uphold: 'upheld', reject: 'rejected', undo: 'undone',
};

function asDecision(kind: Decision['kind'],
                    made: LoopClosure|RejectedCandidate): Decision {
  return {
    kind,
    name: made.name,
    query: Number(made.querySequence),
    matched: Number(made.matchedSequence),
    note: made.note,
    time: made.createTime ? timestampMs(made.createTime) : NaN,
    by: made.decidedBy,
  };
}

function asUndone({name, pair, deleteTime, deletedBy}: DeletedPosePair):
    Undone {
  return {
    ...asDecision(pair.case === 'loopClosure' ? 'confirmed' : 'rejected',
                  pair.value!),
    deletion: name,
    undoneTime: deleteTime ? timestampMs(deleteTime) : NaN,
    undoneBy: deletedBy,
  };
}

/** A pair as people read it. */
export function pairName({query, matched}: Pair): string {
  return `${query.toLocaleString('en')}–${matched.toLocaleString('en')}`;
}

/** Notes that are being written. They outlive a reload of the page, but not its
 * tab. */
class Drafts {
  readonly notes = signal<ReadonlyMap<string, string>>(new Map());
  private place = '';

  /** Shows those about the vehicle with this uid. */
  open(uid: string): void {
    const place = `revisit-notes ${uid}`;
    if (place === this.place) return;
    this.place = place;
    this.notes.value = new Map(Object.entries(JSON.parse(
        sessionStorage.getItem(place) ?? '{}') as Record<string, string>));
  }

  set(key: string, note: string): void {
    const notes = new Map(this.notes.value);
    if (note) {
      notes.set(key, note);
    } else {
      notes.delete(key);
    }
    this.notes.value = notes;
    sessionStorage.setItem(this.place,
                           JSON.stringify(Object.fromEntries(notes)));
  }
}

export class DecisionBook {
  readonly closures = signal<Decision[]>([]);
  readonly rejections = signal<Decision[]>([]);
  readonly all = computed(
      () => [...this.closures.value, ...this.rejections.value]);
  /** All that this page did since it was loaded, the last at the end. */
  readonly deeds = signal<Deed[]>([]);
  /** The pairs that are being confirmed or rejected. */
  readonly underWay = computed(
      () => this.deeds.value.filter(({act, state}) => act !== 'undo' &&
                                        state === 'under way')
                .map(({pair}) => pair));
  readonly drafts = new Drafts();
  /** The decisions that were undone, the last first; undefined until somebody
   * has asked for them. */
  readonly undone = signal<Undone[]|undefined>(undefined);
  /** Why they could not be read. */
  readonly undoneError = signal<string|undefined>(undefined);
  private showsUndone = false;
  private changes = 0;

  /** `changed` is called after each change that was made here. */
  constructor(private readonly parent: string,
              private readonly changed: () => void) {}

  /** Reads all decisions. Returns whether they are others than before, and
   * undefined where one was made here meanwhile: then nothing is taken over,
   * since the lists may be from before it. */
  async read(): Promise<boolean|undefined> {
    const {parent, changes} = this;
    const [closures, rejections] = await Promise.all([
      allPages(pageToken => service.listLoopClosures(
                   {parent, pageToken, pageSize: PAGE_SIZE}),
               page => page.loopClosures),
      allPages(pageToken => service.listRejectedCandidates(
                   {parent, pageToken, pageSize: PAGE_SIZE}),
               page => page.rejectedCandidates),
    ]);
    if (changes !== this.changes) return undefined;
    const before = this.all.value.map(({name}) => name);
    batch(() => {
      this.closures.value = closures.map(made => asDecision('confirmed', made));
      this.rejections.value =
          rejections.map(made => asDecision('rejected', made));
    });
    const after = new Set(this.all.value.map(({name}) => name));
    if (before.some(name => !after.has(name))) this.renewUndone();
    return before.join() !== [...after].join();
  }

  /** Reads the decisions that were undone, and reads them again whenever one
   * more was, until they are shown no longer: nobody else waits for them. */
  showUndone(shown: boolean): void {
    this.showsUndone = shown;
    this.renewUndone();
  }

  private renewUndone(): void {
    if (this.showsUndone) void this.readUndone();
  }

  private async readUndone(): Promise<void> {
    const {parent, changes} = this;
    try {
      const all = await allPages(
          pageToken => service.listDeletedPosePairs(
              {parent, pageToken, pageSize: UNDONE_PAGE_SIZE}),
          page => page.deletedPosePairs);
      // `all` may be from before what was decided here meanwhile: run() reads
      // the list again after that.
      if (changes !== this.changes) return;
      this.undone.value = all.map(asUndone);
      this.undoneError.value = undefined;
    } catch (error) {
      this.undoneError.value = messageOf(error);
    }
  }

  /** Whether something is under way at the pair with this key. */
  isBusy(key: string): boolean {
    return this.deeds.value.some(
        ({at, state}) => at === key && state === 'under way');
  }

  /** The last deed where this pair was shown. */
  lastAt(key: string): Deed|undefined {
    return this.deeds.value.filter(({at}) => at === key).at(-1);
  }

  /** The last decision that was made in this page and still stands. */
  lastMade(): Decision|undefined {
    const names = new Set(this.all.value.map(({name}) => name));
    const made = this.deeds.value.filter(
        ({made: name}) => name !== undefined && names.has(name)).at(-1)?.made;
    return this.all.value.find(({name}) => name === made);
  }

  /** Decides about a pair, with the note that was drafted for it. */
  decide(act: 'confirm'|'reject', pair: Pair): Promise<void> {
    const key = keyOfPair(pair);
    const note = this.drafts.notes.value.get(key) ?? '';
    const name = pairName(pair);
    return this.run({act, pair, at: key}, async () => {
      const decision = act === 'confirm' ? await this.add(pair, note) :
                                           await this.rejectPair(pair, note);
      const list =
          decision.kind === 'confirmed' ? this.closures : this.rejections;
      list.value = [...list.value.filter(
                        ({name: other}) => other !== decision.name), decision];
      this.drafts.set(key, '');
      return {
        made: decision.name,
        text: act === 'confirm' ?
            `Confirmed ${name}. Later searches build on it.` :
            `Rejected ${name}. It is not offered again.`,
      };
    });
  }

  /** Deletes a loop closure or a rejection; `at` is the key of the pair that is
   * shown. */
  undo(decision: Decision, at: string): Promise<void> {
    const {name, kind} = decision;
    return this.run({act: 'undo', pair: decision, at}, async () => {
      if (kind === 'confirmed') {
        await service.deleteLoopClosure({name});
      } else {
        await service.deleteRejectedCandidate({name});
      }
      for (const list of [this.closures, this.rejections]) {
        list.value = list.value.filter(({name: other}) => other !== name);
      }
      return {text: `Undone: ${kind} ${pairName(decision)}.`};
    });
  }

  private async run(begun: Pick<Deed, 'act'|'pair'|'at'>,
                    work: () => Promise<Pick<Deed, 'made'|'text'>>):
      Promise<void> {
    if (this.isBusy(begun.at)) return;
    const deed: Deed = {...begun, id: this.deeds.value.length + 1, text: '…',
                        state: 'under way', time: Date.now()};
    this.deeds.value = [...this.deeds.value, deed];
    const end = (ended: Partial<Deed>) => {
      this.deeds.value = this.deeds.value.map(
          other => other.id === deed.id ? {...deed, ...ended} : other);
    };
    ++this.changes;
    try {
      const done = await work();
      ++this.changes;
      end({state: 'done', ...done});
    } catch (error) {
      end({state: 'failed', text: `${pairName(deed.pair)} was not ${
          VERBS[deed.act]}: ${messageOf(error)}`});
    }
    this.changed();
    this.renewUndone();
  }

  private wordsOf({query, matched}: Pair, note: string) {
    return {querySequence: BigInt(query), matchedSequence: BigInt(matched),
            note};
  }

  private async add(pair: Pair, note: string): Promise<Decision> {
    const {loopClosure} = await service.addLoopClosure(
        {parent: this.parent, loopClosure: this.wordsOf(pair, note)});
    return asDecision('confirmed', loopClosure!);
  }

  private async rejectPair(pair: Pair, note: string): Promise<Decision> {
    const {rejectedCandidate} = await service.rejectCandidate(
        {parent: this.parent, rejectedCandidate: this.wordsOf(pair, note)});
    return asDecision('rejected', rejectedCandidate!);
  }
}
