// Members and pairs of groups, page by page.
import {Code, ConnectError} from '@connectrpc/connect';

import type {GroupMember} from '../../gen/revisit/v1/group_pb.js';
import {allPages, messageOf, service} from './client.js';
import {asLink, asRejection, type GroupDecision, type Link} from
    './group_links.js';

const PAGE_SIZE = 1000;

/** What could be read of a list, and why that is not all. */
export interface Listed<Item> {
  items: Item[];
  damage: string|undefined;
}

/** As allPages(), but for damaged rows: the server leaves them out, and fails
 * behind all others. */
export async function pagesTillDamage<Page extends {nextPageToken: string},
                                      Item>(
    list: (pageToken: string) => Promise<Page>,
    items: (page: Page) => Item[]): Promise<Listed<Item>> {
  const read: Item[] = [];
  try {
    await allPages(list, page => {
      const onPage = items(page);
      read.push(...onPage);
      return onPage;
    });
    return {items: read, damage: undefined};
  } catch (error) {
    if (ConnectError.from(error).code !== Code.DataLoss) throw error;
    return {items: read, damage: messageOf(error)};
  }
}

/** The members of a group that the caller may read. */
export function listMembers(parent: string): Promise<Listed<GroupMember>> {
  return pagesTillDamage(
      pageToken => service.listGroupMembers(
          {parent, pageToken, pageSize: PAGE_SIZE}),
      page => page.members);
}

/** The loop closures between members that the caller may read. */
export function listLinks(parent: string): Promise<Listed<Link>> {
  return pagesTillDamage(
      pageToken => service.listInterVehicleLoopClosures(
          {parent, pageToken, pageSize: PAGE_SIZE}),
      page => page.loopClosures.map(asLink));
}

/** The candidates between members that were rejected, and that the caller may
 * read; undefined where the server is of a version that has none. */
export async function listRejections(parent: string):
    Promise<Listed<GroupDecision>|undefined> {
  try {
    return await pagesTillDamage(
        pageToken => service.listInterVehicleRejectedCandidates(
            {parent, pageToken, pageSize: PAGE_SIZE}),
        page => page.rejectedCandidates.map(asRejection));
  } catch (error) {
    if (ConnectError.from(error).code !== Code.Unimplemented) throw error;
    return undefined;
  }
}
