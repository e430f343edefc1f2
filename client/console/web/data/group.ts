// One group as the page knows it, kept up to date while somebody looks.
import {batch, computed, type Signal, signal} from '@preact/signals';

import type {Group, GroupMember} from '../../gen/revisit/v1/group_pb.js';
import {messageOf, repeat, service} from './client.js';
import {link, reject, takeBack} from './group_decisions.js';
import {type GroupDecision, type Link, type PosePair, posesName} from
    './group_links.js';
import {listLinks, listMembers, listRejections} from './group_lists.js';
import {versionOf} from './groups.js';

const POLL_MILLISECONDS = 1000;

/** The outcome of the last decision that was made or deleted here. */
export interface Outcome {
  text: string;
  failed: boolean;
}

/** The effect that a decision has from now on. */
const EFFECTS: Record<GroupDecision['kind'], string> = {
  linked: 'Later searches build on it.',
  rejected: 'Searches in the group offer it no more.',
};

export class GroupStore {
  readonly name: string;
  readonly group = signal<Group|undefined>(undefined);
  /** Those that the caller may read; undefined until they were. */
  readonly members = signal<GroupMember[]|undefined>(undefined);
  readonly links = signal<Link[]>([]);
  readonly rejections = signal<GroupDecision[]>([]);
  readonly decisions = computed<GroupDecision[]>(
      () => [...this.links.value, ...this.rejections.value]);
  /** Whether the server is of a version that rejects nothing between members. */
  readonly isWithoutRejections = signal(false);
  /** Why members or decisions are missing. */
  readonly damage = signal<string|undefined>(undefined);
  readonly error = signal<string|undefined>(undefined);
  readonly outcome = signal<Outcome|undefined>(undefined);
  /** Whether a decision is being made or deleted. */
  readonly isBusy = signal(false);
  private readonly end: () => void;
  /** The versionOf() the group whose members and decisions are here. */
  private listed = '';
  private changes = 0;
  /** Names of decisions that were made here, the last at the end. */
  private readonly made = signal<string[]>([]);

  constructor(id: string) {
    this.name = `groups/${id}`;
    this.end = repeat(POLL_MILLISECONDS, () => this.refresh());
  }

  close(): void {
    this.end();
  }

  /** Reads the group and, if it has changed, what it holds. */
  async refresh(): Promise<void> {
    try {
      const {changes} = this;
      const {group} = await service.getGroup({name: this.name});
      const version = versionOf(group!);
      const isNew = version !== this.listed;
      const members = isNew && await listMembers(this.name);
      const links = isNew && await listLinks(this.name);
      const rejections = isNew && await listRejections(this.name);
      // The lists may be older than what was changed here meanwhile.
      if (changes !== this.changes) return;
      batch(() => {
        if (members && links) {
          this.listed = version;
          this.members.value = members.items;
          this.links.value = links.items;
          this.isWithoutRejections.value = rejections === undefined;
          this.rejections.value = rejections ? rejections.items : [];
          this.damage.value = members.damage ?? links.damage ??
              (rejections ? rejections.damage : undefined);
        }
        this.group.value = group;
        this.error.value = undefined;
      });
    } catch (error) {
      this.error.value = messageOf(error);
      throw error;
    }
  }

  /** The last decision that was made in this page and still stands. */
  lastMade(): GroupDecision|undefined {
    const all = new Map(this.decisions.value.map(made => [made.name, made]));
    return this.made.value.map(name => all.get(name))
        .filter(made => made !== undefined).at(-1);
  }

  /** Decides about two poses. Returns whether that was done. */
  decide(kind: GroupDecision['kind'], poses: PosePair, note: string):
      Promise<boolean> {
    const name = posesName(poses);
    return this.run(`${name} was not ${kind}`, async () => {
      if (kind === 'linked') {
        this.keep(this.links, await link(this.name, poses, note));
      } else {
        this.keep(this.rejections, await reject(this.name, poses, note));
      }
      return `${kind === 'linked' ? 'Linked' : 'Rejected'} ${name}. ${
          EFFECTS[kind]}`;
    });
  }

  /** Deletes a decision, whoever has made it. Returns whether that was done. */
  remove(decision: GroupDecision): Promise<boolean> {
    const {kind, name} = decision;
    const poses = posesName(decision);
    return this.run(`${poses} was not deleted`, async () => {
      await takeBack(decision);
      const isOther = (one: GroupDecision) => one.name !== name;
      this.links.value = this.links.value.filter(isOther);
      this.rejections.value = this.rejections.value.filter(isOther);
      return `Deleted the ${kind === 'linked' ? 'link' : 'rejection of'} ${
          poses}.`;
    });
  }

  private keep<Decision extends GroupDecision>(list: Signal<Decision[]>,
                                               made: Decision): void {
    list.value = [...list.value.filter(({name}) => name !== made.name), made];
    this.made.value = [...this.made.value, made.name];
  }

  /** One change after the other: a second one while the first is under way is
   * not begun. */
  private async run(failure: string, work: () => Promise<string>):
      Promise<boolean> {
    if (this.isBusy.value) return false;
    this.isBusy.value = true;
    ++this.changes;
    let done = false;
    try {
      this.outcome.value = {text: await work(), failed: false};
      done = true;
    } catch (error) {
      this.outcome.value =
          {text: `${failure}: ${messageOf(error)}`, failed: true};
    }
    ++this.changes;
    this.isBusy.value = false;
    this.refresh().catch(() => undefined);
    return done;
  }
}
