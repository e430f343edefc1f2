import {batch} from '@preact/signals';
import {useEffect, useMemo, useRef, useState} from 'preact/hooks';

import {FrameStore} from '../data/group_frame_store.js';
import {GroupStore} from '../data/group.js';
import {foundIn} from '../data/group_found.js';
import {type Frames, isOnMap} from '../data/group_frames.js';
import {vehicleId} from '../data/group_links.js';
import {PathStore} from '../data/group_path_store.js';
import type {MemberPath} from '../data/group_paths.js';
import {type Asked, GroupSearch, isSameSearch} from
    '../data/group_search.js';
import {versionOf} from '../data/groups.js';
import {MapView} from '../draw/map.js';
import type {MapSheet} from '../draw/svg.js';
import {Export} from '../parts/export.js';
import {type Fact, FactList} from '../parts/facts.js';
import {count, length} from '../parts/format.js';
import {query, setQuery} from '../route.js';
import {useTitle} from '../title.js';
import {coloursOf, placeLink, posesOfLinks, sceneOfGroup} from
    './group_map.js';
import {SearchPanel} from './group_search.js';
import {LinkTable, memberRows, MemberTable, RejectionTable} from
    './group_tables.js';

/** Members whose paths are read until somebody asks for more. */
const PATHS_AT_ONCE = 50;
const MOST_NAMED = 10;
const NOTHING_TOLD: Frames = new Map();

/** What the address asks to be searched: a vehicle, and `@` with a pose of
 * it. */
function askedIn(parameters: URLSearchParams): Asked|undefined {
  const found = /^([a-z0-9-]+)(?:@(\d+))?$/.exec(parameters.get('asked') ?? '');
  return found ? {vehicle: found[1], sequence: Number(found[2] ?? 0),
                  excludeOwn: parameters.get('own') === 'off'} : undefined;
}

function writeAsked({vehicle, sequence, excludeOwn}: Asked): void {
  batch(() => {
    setQuery('own', excludeOwn ? 'off' : undefined);
    setQuery('asked', sequence > 0 ? `${vehicle}@${sequence}` : vehicle);
  });
}

/** The members to draw: that of the map's frame, then those that have a place in
 * it, as they are listed. */
function membersToDraw(members: readonly string[], reference: string|undefined,
                       frames: Frames|undefined, most: number): string[] {
  if (!frames || reference === undefined) return [];
  const placed = members.filter(
      id => id !== reference && isOnMap(frames.get(id)));
  return [reference, ...placed].slice(0, most);
}

/** The first of these names. */
function namesIn(ids: readonly string[]): string {
  const more = ids.length - MOST_NAMED;
  return ids.slice(0, MOST_NAMED).join(', ') +
      (more > 0 ? ` and ${count(more)} others` : '');
}

/** Says what the map leaves out, why, and how exact it is. */
function ShownMembers({members, reference, frames, paths, drawn, onMore}: {
  members: readonly string[], reference: string, frames: Frames,
  paths: ReadonlyMap<string, MemberPath>, drawn: ReadonlySet<string>,
  onMore: () => void,
}) {
  const told = members.filter(id => frames.has(id));
  const unplaced = told.filter(id => !isOnMap(frames.get(id)));
  const placed = told.length - unplaced.length;
  const tolerance = Math.max(0, ...[...paths.values()].map(
      ({toleranceMeters}) => 1.5 * toleranceMeters));
  const untold = members.filter(id => !frames.has(id));
  const more = placed - drawn.size;
  return (
    <>
      {unplaced.length > 0 && (
        <p class="hint" role="status">
          Not placed, since nothing ties them to {reference}:{' '}
          {namesIn(unplaced)}.
        </p>
      )}
      {untold.length > 0 && (
        <p class="hint" role="status">
          Not told by the server, since they have no poses, were not read yet, or
          cannot be compared with {reference}: {namesIn(untold)}.
        </p>
      )}
      {more > 0 && (
        <p class="hint">
          {count(drawn.size)} of {count(placed)} members that are placed are on
          the map.{' '}
          <button type="button" onClick={onMore}>
            Draw {count(Math.min(PATHS_AT_ONCE, more))} more
          </button>
        </p>
      )}
      {tolerance > 0 && (
        <p class="hint">
          Paths are drawn to within {length(tolerance)}.
        </p>
      )}
    </>
  );
}

export function GroupView({id}: {id: string}) {
  const store = useMemo(() => new GroupStore(id), []);
  const frameStore = useMemo(() => new FrameStore(`groups/${id}`), []);
  const pathStore = useMemo(() => new PathStore(), []);
  const search = useMemo(() => new GroupSearch(`groups/${id}`), []);
  useEffect(() => () => {
    for (const each of [store, frameStore, pathStore, search]) each.close();
  }, []);
  const sheet = useRef<MapSheet>();
  const [pointed, setPointed] = useState<string>();
  const [most, setMost] = useState(PATHS_AT_ONCE);
  const group = store.group.value;
  const listed = store.members.value;
  const links = store.links.value;
  const members = useMemo(
      () => (listed ?? []).map(({vehicle}) => vehicleId(vehicle)), [listed]);
  const named = query.value.get('from');
  const reference = members.find(member => member === named) ?? members[0];

  const version = group ? versionOf(group) : '';
  useEffect(() => frameStore.show(reference, version), [reference, version]);
  const frames = frameStore.frames.value;
  const paths = pathStore.paths.value;
  const drawn = useMemo(
      () => new Set(membersToDraw(members, reference, frames, most)),
      [members, reference, frames, most]);
  const poses = useMemo(() => posesOfLinks(links), [links]);
  useEffect(() => pathStore.want(new Map([...drawn].map(
                member => [member, poses.get(member) ?? new Set()]))),
            [drawn, poses]);

  const colours = useMemo(() => coloursOf(members), [members]);
  const rows = useMemo(() => memberRows(listed ?? [], colours),
                       [listed, colours]);
  const placed = useMemo(() => new Map((frames ? links : []).flatMap(link => {
    const one = placeLink(link, {frames: frames!, paths});
    return one ? [[link.name, one] as const] : [];
  })), [links, frames, paths]);
  const scene = useMemo(() => sceneOfGroup(
      {members, frames: frames ?? new Map(), paths}, [...placed.values()]),
      [members, frames, paths, placed]);

  const text = query.value.get('asked');
  const own = query.value.get('own');
  const asked = useMemo(() => askedIn(query.value), [text, own]);
  const ask = (wanted: Asked) => {
    void search.search(wanted);
    writeAsked(wanted);
  };
  useEffect(() => {
    const before = search.asked.value;
    if (asked && !(before && isSameSearch(asked, before))) {
      void search.search(asked);
    }
  }, [asked]);
  const set = search.set.value;
  const found = useMemo(
      () => set && search.asked.value ?
          foundIn(search.asked.value.vehicle, set) : [], [set]);

  const name = group?.displayName || id;
  useTitle(name);
  const facts: Fact[] = [
    ['Members', count(members.length)],
    ['Links', count(links.length)],
    ['Rejected', count(store.rejections.value.length)],
    ['Revision', count(group?.revision ?? 0)],
  ];
  return (
    <>
      <div class="title">
        <h1>{name}</h1>
        {name !== id && <code>{id}</code>}
        <p role="status">
          {!group && !store.error.value ? 'Asking the server…' :
           frameStore.isReading.value ?
             'The server is reading the histories of the members…' :
           reference && frames ? `Map in the frame of ${reference}` : ''}
        </p>
        <Export name={id} sheet={() => ({
          title: `${name}, in the frame of ${reference ?? 'none'}`,
          map: sheet.current,
          facts,
        })} />
      </div>
      {[store.error.value, store.damage.value, frameStore.error.value].map(
          error => error && <p key={error} class="error" role="status">
            {error}</p>)}
      {group && <FactList short facts={facts} />}
      {frameStore.isUnknown.value && (
        <p class="hint" role="status">
          This revisitd is of a version that does not tell where members lie, so
          there is no map.
        </p>
      )}
      {listed && (
        <div class={scene.box ? 'map-and-table' : ''}>
          {scene.box && (
            <MapView key={reference} scene={scene} shownRef={sheet}
                     pointed={pointed} onPoint={setPointed}
                     label={`Map of the members of ${name} in the frame of ${
                         reference}; the tables have the same`} />
          )}
          <div class="side">
            {reference && frames && (
              <ShownMembers members={members} reference={reference}
                            frames={frames} paths={paths} drawn={drawn}
                            onMore={() => setMost(most + PATHS_AT_ONCE)} />
            )}
            <h2>Members</h2>
            <MemberTable rows={rows} reference={reference}
                         frames={frameStore.isUnknown.value ? NOTHING_TOLD :
                                                              frames}
                         paths={paths} errors={pathStore.errors.value}
                         drawn={drawn} searched={set} pointed={pointed}
                         onPoint={setPointed}
                         onSearch={vehicle => ask({
                           vehicle, sequence: 0,
                           excludeOwn: asked?.excludeOwn ?? false})} />
            <h2>Links</h2>
            <LinkTable store={store} placed={placed} pointed={pointed}
                       onPoint={setPointed} />
            <h2>Rejected candidates</h2>
            {store.isWithoutRejections.value ? (
              <p class="hint" role="status">
                This revisitd is of a version that rejects no candidates between
                vehicles.
              </p>
            ) : <RejectionTable store={store} />}
          </div>
        </div>
      )}
      {listed && (
        <SearchPanel store={store} search={search} members={members}
                     asked={asked} found={found} onAsk={ask} pointed={pointed}
                     onPoint={setPointed} />
      )}
    </>
  );
}
