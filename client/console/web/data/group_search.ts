// Searches in the histories of a group's members.
import {signal} from '@preact/signals';

import type {CandidateSet} from '../../gen/revisit/v1/candidate_pb.js';
import {idle, messageOf, service} from './client.js';
import {isPartial} from './group_found.js';
import type {PosePlace} from './group_links.js';

/** How long a search that lacks histories waits until it is made again. */
const AGAIN_MILLISECONDS = 1000;

/** What to search: `sequence` 0 is the newest pose. */
export interface Asked extends PosePlace {
  /** Whether the vehicle's own history is left out. */
  excludeOwn: boolean;
}

export function isSameSearch(a: Asked, b: Asked): boolean {
  return a.vehicle === b.vehicle && a.sequence === b.sequence &&
      a.excludeOwn === b.excludeOwn;
}

export class GroupSearch {
  /** What was asked last. */
  readonly asked = signal<Asked|undefined>(undefined);
  /** The answer to that, as far as there is one. */
  readonly set = signal<CandidateSet|undefined>(undefined);
  readonly error = signal<string|undefined>(undefined);
  readonly isUnderWay = signal(false);
  private generation = 0;

  constructor(private readonly group: string) {}

  close(): void {
    ++this.generation;
  }

  /** Searches, and again as long as histories are being read. */
  async search(asked: Asked): Promise<void> {
    const generation = ++this.generation;
    this.asked.value = asked;
    this.set.value = undefined;
    this.error.value = undefined;
    this.isUnderWay.value = true;
    const isCurrent = () => generation === this.generation;
    try {
      for (;;) {
        const {candidates} = await service.findCandidates({
          vehicle: `vehicles/${asked.vehicle}`,
          sequence: BigInt(asked.sequence),
          options: {scope: {group: this.group, excludeOwn: asked.excludeOwn,
                            allowPartial: true}},
        });
        if (!isCurrent()) return;
        this.set.value = candidates;
        if (!isPartial(candidates!)) break;
        do {
          await new Promise(done => setTimeout(done, AGAIN_MILLISECONDS));
          if (!isCurrent()) return;
        } while (idle.value);
      }
    } catch (error) {
      if (isCurrent()) this.error.value = messageOf(error);
    }
    if (isCurrent()) this.isUnderWay.value = false;
  }
}
