// One group as the page knows it, kept up to date while somebody looks.
import {batch, signal} from '@preact/signals';

import type {Group, GroupMember} from '../../gen/revisit/v1/group_pb.js';
import {messageOf, repeat, service} from './client.js';
import {asLink, type Link, linkName, type PosePlace} from './group_links.js';
import {listLinks, listMembers} from './group_lists.js';
import {versionOf} from './groups.js';

const POLL_MILLISECONDS = 1000;

/** What came of the last link that was added or deleted here. */
export interface Outcome {
  text: string;
  failed: boolean;
}

export class GroupStore {
  readonly name: string;
  readonly group = signal<Group|undefined>(undefined);
  /** Those that the caller may read; undefined until they were. */
  readonly members = signal<GroupMember[]|undefined>(undefined);
  readonly links = signal<Link[]>([]);
  /** Why members or links are missing. */
  readonly damage = signal<string|undefined>(undefined);
  readonly error = signal<string|undefined>(undefined);
  readonly outcome = signal<Outcome|undefined>(undefined);
  /** Whether a link is being added or deleted. */
  readonly isBusy = signal(false);
  private readonly end: () => void;
  /** The versionOf() the group whose members and links are here. */
  private listed = '';
  private changes = 0;
  /** Names of links that were added here, the last at the end. */
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
      // The lists may be older than what was changed here meanwhile.
      if (changes !== this.changes) return;
      batch(() => {
        if (members && links) {
          this.listed = version;
          this.members.value = members.items;
          this.links.value = links.items;
          this.damage.value = members.damage ?? links.damage;
        }
        this.group.value = group;
        this.error.value = undefined;
      });
    } catch (error) {
      this.error.value = messageOf(error);
      throw error;
    }
  }

  /** The last link that was added in this page and is still there. */
  lastMade(): Link|undefined {
    const links = new Map(this.links.value.map(link => [link.name, link]));
    return this.made.value.map(name => links.get(name))
        .filter(link => link !== undefined).at(-1);
  }

  /** Ties the two vehicles at these poses, which somebody has found to be one
   * place. Returns whether that was done. */
  add(query: PosePlace, matched: PosePlace, note: string): Promise<boolean> {
    const pose = ({vehicle, sequence}: PosePlace) => ({
      vehicle: `vehicles/${vehicle}`, sequence: BigInt(sequence)});
    const name = linkName({query, matched});
    return this.run(`${name} was not linked`, async () => {
      const {loopClosure} = await service.addInterVehicleLoopClosure({
        parent: this.name,
        loopClosure: {query: pose(query), matched: pose(matched), note},
      });
      const link = asLink(loopClosure!);
      this.links.value = [
        ...this.links.value.filter(other => other.name !== link.name), link];
      this.made.value = [...this.made.value, link.name];
      return `Linked ${name}. Later searches build on it.`;
    });
  }

  /** Deletes a link, whoever has added it. Returns whether that was done. */
  remove(link: Link): Promise<boolean> {
    return this.run(`${linkName(link)} was not deleted`, async () => {
      await service.deleteInterVehicleLoopClosure({name: link.name});
      this.links.value =
          this.links.value.filter(({name}) => name !== link.name);
      return `Deleted the link ${linkName(link)}.`;
    });
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
