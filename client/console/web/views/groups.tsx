import {useEffect, useMemo, useState} from 'preact/hooks';

import {GroupsStore, type ListedGroup} from '../data/groups.js';
import {Export} from '../parts/export.js';
import {count, time} from '../parts/format.js';
import {type Column, Table} from '../parts/table.js';
import {query, setQuery} from '../route.js';
import {useTitle} from '../title.js';

/** A file has no more of them. */
const MOST_SAVED = 200;

function countText(counts: ListedGroup['counts'], which: 'members'|'links'):
    string {
  return !counts ? '…' :
                   `${counts.damage ? 'at least ' : ''}${count(counts[which])}`;
}

const COLUMNS: Array<Column<ListedGroup>> = [
  {title: 'Group', by: ({id, group}) => group.displayName || id,
   cell: ({id, group}) => (
    <>
      <a href={`/groups/${id}`}>{group.displayName || id}</a>
      {group.displayName && group.displayName !== id && <> <code>{id}
        </code></>}
    </>)},
  {title: 'Members', number: true, by: ({counts}) => counts?.members ?? NaN,
   cell: ({counts}) => countText(counts, 'members')},
  {title: 'Links', number: true, by: ({counts}) => counts?.links ?? NaN,
   cell: ({counts}) => countText(counts, 'links')},
  {title: 'Lies on the Earth', cell: ({group}) =>
     group.settings?.geodeticOrigin ? 'yes' : ''},
  {title: 'Revision', number: true, by: ({group}) => Number(group.revision),
   cell: ({group}) => count(group.revision)},
  {title: 'Created', by: ({group}) => time(group.createTime),
   cell: ({group}) => time(group.createTime)},
];

function matches({id, group}: ListedGroup, search: string): boolean {
  const text = `${id}\n${group.displayName}`.toLowerCase();
  return search.toLowerCase().split(/\s+/).every(word => text.includes(word));
}

export function GroupsView() {
  const store = useMemo(() => new GroupsStore(), []);
  useEffect(() => () => store.close(), []);
  const all = store.groups.value;
  const search = query.value.get('search') ?? '';
  const groups = useMemo(
      () => (all ?? []).filter(group => matches(group, search)),
      [all, search]);
  const [visible, setVisible] = useState<ListedGroup[]>([]);
  useEffect(() => store.show(visible.map(({group}) => group.name)), [visible]);
  useTitle('Groups');
  return (
    <>
      <div class="title">
        <h1>Groups</h1>
        <p role="status">
          {all ? `${count(groups.length)} of ${count(all.length)} groups` :
                 store.error.value ? '' : 'Asking the server…'}
        </p>
        <Export name="groups" sheet={() => ({
          title: 'Groups',
          facts: groups.slice(0, MOST_SAVED).map(({id, counts}) =>
              [id, `${countText(counts, 'members')} members, ${
                  countText(counts, 'links')} links`]),
        })} />
      </div>
      {store.isUnknown.value ?
        <p role="status">This revisitd is of a version without groups.</p> :
        store.error.value && <p class="error" role="status">
          {store.error.value}</p>}
      <form class="filters" role="search" onSubmit={e => e.preventDefault()}>
        <label>
          Search
          <input type="search" name="search" value={search} placeholder="id, name"
                 onInput={event => setQuery(
                     'search', event.currentTarget.value || undefined)} />
        </label>
      </form>
      <Table label="Groups" columns={COLUMNS} rows={groups}
             keyOf={({id}) => id} onVisible={setVisible}
             empty={all ? (all.length > 0 ? 'No group is like that.' :
                           'There is no group that you may read.') : ''} />
      <p class="hint">
        Vehicles of one group are searched together. Members and links are those
        that you may read.
      </p>
    </>
  );
}
