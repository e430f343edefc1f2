// The members of a group and the decisions about pairs of them, as tables.
import {useState} from 'preact/hooks';

import {type CandidateSet, UnsearchedReason} from
    '../../gen/revisit/v1/candidate_pb.js';
import type {GroupMember} from '../../gen/revisit/v1/group_pb.js';
import type {GroupStore} from '../data/group.js';
import {type Frames, isOnMap} from '../data/group_frames.js';
import {type GroupDecision, type Link, placeName, type PosePlace, posesName,
        vehicleId} from '../data/group_links.js';
import type {MemberPath} from '../data/group_paths.js';
import type {Colour} from '../draw/scene.js';
import {count, degrees, duration, fixed, instant, length, words} from
    '../parts/format.js';
import {type Column, Table} from '../parts/table.js';
import {setQuery} from '../route.js';
import {frameText, type PlacedLink} from './group_map.js';

/** A member with all that is known of it. */
export interface MemberRow {
  id: string;
  member: GroupMember;
  colour: Colour;
}

interface MembersProps {
  rows: MemberRow[];
  /** The member in whose frame the map is. */
  reference: string|undefined;
  frames: Frames|undefined;
  paths: ReadonlyMap<string, MemberPath>;
  errors: ReadonlyMap<string, string>;
  /** Members whose paths are wanted. */
  drawn: ReadonlySet<string>;
  /** The last search in the group. */
  searched: CandidateSet|undefined;
  pointed: string|undefined;
  onPoint: (key: string|undefined) => void;
  onSearch: (vehicle: string) => void;
}

/** How old a member's state was in the last search, or why it was not
 * searched. */
function lagText(set: CandidateSet|undefined, {member}: MemberRow): string {
  const unsearched = set?.unsearched.find(
      ({vehicle}) => vehicle === member.vehicle);
  if (unsearched) {
    return `not searched: ${words(UnsearchedReason[unsearched.reason])}`;
  }
  const lag = set?.searched.find(
      ({vehicle}) => vehicle === member.vehicle)?.lag;
  return lag ? duration(Number(lag.seconds) + lag.nanos / 1e9) : '–';
}

function pathText({id}: MemberRow,
                  {frames, paths, errors, drawn}: MembersProps): string {
  const path = paths.get(id);
  const error = errors.get(id);
  if (error) return error;
  if (path) {
    return path.x.length === 0 ? 'no poses yet' :
        `${length(path.travelled)}${path.isCut ? ', drawn in part' : ''}`;
  }
  return drawn.has(id) ? 'being read' :
      isOnMap(frames?.get(id)) ? 'not read' : '–';
}

/** The recording whose tie stands for the member: its last one. */
function lastFrameText({id}: MemberRow, frames: Frames|undefined): string {
  if (!frames) return '…';
  const all = frames.get(id);
  if (!all) return 'not told';
  const text = frameText(all.at(-1));
  const placed = all.filter(({motion}) => motion).length;
  return all.length === 1 ? text :
      `${text}; ${count(placed)} of ${count(all.length)} recordings placed`;
}

export function MemberTable(props: MembersProps) {
  const {rows, reference, frames, paths, searched, onSearch} = props;
  const columns: Array<Column<MemberRow>> = [
    {title: 'Vehicle', by: ({id}) => id, cell: ({id, colour}) => (
      <>
        <span class={`swatch ${colour}`} />
        <a href={`/vehicles/${id}`}>{paths.get(id)?.title || id}</a>
        {paths.get(id)?.title && paths.get(id)!.title !== id &&
          <> <code>{id}</code></>}
      </>)},
    {title: 'Map', cell: ({id}) => (
      <button type="button" aria-pressed={id === reference}
              aria-label={`Map here: ${id}`}
              onClick={() => setQuery('from', id)}>
        Map here
      </button>)},
    {title: 'Search', cell: ({id}) => (
      <button type="button" aria-label={`Search: ${id}`}
              onClick={() => onSearch(id)}>
        Search
      </button>)},
    {title: 'Frame', by: row => lastFrameText(row, frames),
     cell: row => lastFrameText(row, frames)},
    {title: 'Path', by: ({id}) => paths.get(id)?.travelled ?? NaN,
     cell: row => pathText(row, props)},
    {title: 'Lag', by: row => lagText(searched, row),
     cell: row => lagText(searched, row)},
    {title: 'Datum', by: ({member}) => member.datum ? 0 : 1,
     cell: ({member: {datum}}) => datum ? datum.datumId || 'yes' : ''},
  ];
  return <Table label="Members" columns={columns} rows={rows}
                keyOf={({id}) => id} current={reference}
                pointed={props.pointed} onPoint={props.onPoint}
                empty="No member that you may read." />;
}

function measurementText({measurement}: Link): string {
  if (!measurement) return 'none';
  const {xMeters, yMeters, headingRadians} = measurement;
  return `x ${fixed(xMeters, 2)}, y ${fixed(yMeters, 2)} m, ${
      degrees(headingRadians)}`;
}

function PoseLink({vehicle, sequence}: PosePlace) {
  return (
    <a href={`/vehicles/${vehicle}?at=${sequence}`}>
      {placeName({vehicle, sequence})}
    </a>
  );
}

/** Deletes where it is pressed twice: nobody can undo that. */
function DeleteButton({store, made}: {store: GroupStore, made: GroupDecision}) {
  const [asked, setAsked] = useState(false);
  const name = posesName(made);
  return (
    <button type="button" disabled={store.isBusy.value}
            aria-label={`${asked ? 'Really delete' : 'Delete'} ${name}`}
            onBlur={() => setAsked(false)}
            onClick={() => asked ? void store.remove(made) : setAsked(true)}>
      {asked ? 'Really delete' : 'Delete'}
    </button>
  );
}

function tieText(placed: PlacedLink|undefined): string {
  return !placed ? 'not on the map' : placed.isKnown ? 'known' : 'estimated';
}

interface DecisionsProps<Decision> {
  label: string;
  store: GroupStore;
  rows: Decision[];
  /** Columns that these have besides. */
  more?: Array<Column<Decision>>;
  empty: string;
  pointed?: string;
  onPoint?: (key: string|undefined) => void;
}

/** Decisions with their poses, who made them when, and how to delete them. */
function DecisionTable<Decision extends GroupDecision>(
    {label, store, rows, more = [], empty, pointed, onPoint}:
    DecisionsProps<Decision>) {
  const columns: Array<Column<Decision>> = [
    {title: 'Query', by: ({query}) => placeName(query),
     cell: ({query}) => <PoseLink {...query} />},
    {title: 'Match', by: ({matched}) => placeName(matched),
     cell: ({matched}) => <PoseLink {...matched} />},
    {title: 'Delete', cell: made => <DeleteButton store={store} made={made} />},
    ...more,
    {title: 'When', by: ({time}) => time, cell: ({time}) => instant(time)},
    {title: 'By', by: ({by}) => by, cell: ({by}) => by},
    {title: 'Note', by: ({note}) => note, cell: ({note}) => note},
  ];
  return <Table label={label} columns={columns} rows={rows}
                keyOf={({name}) => name} pointed={pointed} onPoint={onPoint}
                empty={empty} />;
}

export function LinkTable({placed, ...shown}: {
  store: GroupStore, placed: ReadonlyMap<string, PlacedLink>,
  pointed: string|undefined, onPoint: (key: string|undefined) => void,
}) {
  const more: Array<Column<Link>> = [
    {title: 'Frames', by: ({name}) => tieText(placed.get(name)),
     cell: ({name}) => tieText(placed.get(name))},
    {title: 'Apart', number: true, by: ({name}) => placed.get(name)?.apart ?? NaN,
     cell: ({name}) => placed.has(name) ? length(placed.get(name)!.apart) :
                                          '–'},
    {title: 'Measured', cell: measurementText},
  ];
  return <DecisionTable {...shown} label="Links" rows={shown.store.links.value}
                        more={more} empty="Nobody has linked two members." />;
}

export function RejectionTable({store}: {store: GroupStore}) {
  return <DecisionTable label="Rejected candidates" store={store}
                        rows={store.rejections.value}
                        empty="Nobody has rejected a candidate between two members." />;
}

/** The rows of members, in the order of the list. */
export function memberRows(members: readonly GroupMember[],
                           colours: ReadonlyMap<string, Colour>): MemberRow[] {
  return members.map(member => {
    const id = vehicleId(member.vehicle);
    return {id, member, colour: colours.get(id)!};
  });
}
