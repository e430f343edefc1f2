// All groups that the caller may read, with what they hold.
import {Code, ConnectError} from '@connectrpc/connect';
import {signal} from '@preact/signals';

import type {Group} from '../../gen/revisit/v1/group_pb.js';
import {allPages, messageOf, repeat, service} from './client.js';
import {listLinks, listMembers} from './group_lists.js';

const POLL_MILLISECONDS = 2000;
const PAGE_SIZE = 1000;
/** Groups whose members and links are counted, those in view first. */
const MOST_COUNTED = 100;

/** How much a group holds of what the caller may read. */
export interface Counts {
  members: number;
  links: number;
  /** Why it may hold more. */
  damage: string|undefined;
}

export interface ListedGroup {
  id: string;
  group: Group;
  /** Undefined until it was asked for. */
  counts: Counts|undefined;
}

/** Changes whenever the group does, also into another one of its name. */
export function versionOf({uid, revision}: Group): string {
  return `${uid} ${revision}`;
}

async function countsOf(name: string): Promise<Counts> {
  const members = await listMembers(name);
  const links = await listLinks(name);
  return {members: members.items.length, links: links.items.length,
          damage: members.damage ?? links.damage};
}

export class GroupsStore {
  readonly groups = signal<ListedGroup[]|undefined>(undefined);
  /** Whether the server is of a version that has none. */
  readonly isUnknown = signal(false);
  readonly error = signal<string|undefined>(undefined);
  private readonly counted =
      new Map<string, {version: string, counts: Counts}>();
  private shown: string[] = [];
  private listed: Group[] = [];
  private readonly end = repeat(POLL_MILLISECONDS, () => this.refresh());

  close(): void {
    this.end();
    this.shown = [];
  }

  /** Says what of these is wanted, the most urgent first. */
  show(names: string[]): void {
    this.shown = names.slice(0, MOST_COUNTED);
    void this.count();
  }

  private async refresh(): Promise<void> {
    try {
      this.listed = await allPages(
          pageToken => service.listGroups({pageToken, pageSize: PAGE_SIZE}),
          page => page.groups);
      this.publish();
      this.error.value = undefined;
      await this.count();
    } catch (error) {
      this.isUnknown.value =
          ConnectError.from(error).code === Code.Unimplemented;
      this.error.value = messageOf(error);
      throw error;
    }
  }

  /** Counts what is shown and was not counted in this version. */
  private async count(): Promise<void> {
    const {shown} = this;
    for (const name of shown) {
      // Somebody scrolled on, and others are wanted.
      if (shown !== this.shown) return;
      const group = this.listed.find(other => other.name === name);
      if (!group || this.counted.get(name)?.version === versionOf(group)) {
        continue;
      }
      const counts = await countsOf(name).catch(() => undefined);
      if (!counts) continue;
      this.counted.set(name, {version: versionOf(group), counts});
      this.publish();
    }
  }

  private publish(): void {
    this.groups.value = this.listed.map(group => ({
      id: group.name.replace('groups/', ''),
      group,
      counts: this.counted.get(group.name)?.counts,
    }));
  }
}
