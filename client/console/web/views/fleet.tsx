import {useEffect, useMemo, useRef, useState} from 'preact/hooks';

import type {Pose} from '../../gen/revisit/v1/geometry_pb.js';
import {CoordinateFrame, FindingCode} from
    '../../gen/revisit/v1/vehicle_pb.js';
import {type Activity, FleetStore, type FleetVehicle} from
    '../data/fleet.js';
import {MapView} from '../draw/map.js';
import {type Colour, dots, type Scene} from '../draw/scene.js';
import type {MapSheet} from '../draw/svg.js';
import {type Frame, mercatorFrame, type Place} from '../geometry/frame.js';
import {boxAround} from '../geometry/view.js';
import {Export} from '../parts/export.js';
import {count, fixed, length, time, words} from '../parts/format.js';
import {type Column, Table} from '../parts/table.js';
import {query, setQuery} from '../route.js';
import {useTitle} from '../title.js';

/** How far the first vehicle may be from the origin of the map's frame. */
const FRAME_DEGREES = 0.2;

const ACTIVITIES: Activity[] = ['streaming', 'idle', 'data loss', 'damaged'];

/** Text that the search looks through. */
function searchable({id, vehicle}: FleetVehicle): string {
  const labels = Object.entries(vehicle.labels)
                     .map(([key, value]) => `${key}=${value}`);
  return [id, vehicle.displayName, ...labels].join('\n').toLowerCase();
}

function matches(vehicle: FleetVehicle, filters: URLSearchParams): boolean {
  const words = (filters.get('search') ?? '').toLowerCase().split(/\s+/);
  const text = searchable(vehicle);
  const activity = filters.get('state');
  return words.every(word => text.includes(word)) &&
      (!activity || vehicle.activity === activity) &&
      (!filters.has('findings') || vehicle.vehicle.findings.length > 0);
}

function positionText({position, stamp}: Pose): string {
  const place = position.case === 'local' ?
      `x ${fixed(position.value.xMeters, 1)}, y ${
          fixed(position.value.yMeters, 1)} m` :
      position.case === 'geodetic' ?
      `${fixed(position.value.latitudeDegrees, 6)}°, ${
          fixed(position.value.longitudeDegrees, 6)}°` :
      '';
  return stamp ? `${place}, ${time(stamp)}` : place;
}

const COLUMNS: Array<Column<FleetVehicle>> = [
  {title: 'Vehicle', by: ({id, vehicle}) => vehicle.displayName || id,
   cell: ({id, vehicle}) => (
    <>
      <a href={`/vehicles/${id}`}>{vehicle.displayName || id}</a>
      {vehicle.displayName && vehicle.displayName !== id && <> <code>{id}
        </code></>}
    </>)},
  {title: 'State', by: ({activity}) => activity, cell: ({activity}) => (
    <span class={`state ${activity.replace(' ', '-')}`}>{activity}</span>)},
  {title: 'Poses', number: true,
   by: ({vehicle}) => Number(vehicle.durableSequence),
   cell: ({vehicle}) => count(vehicle.durableSequence)},
  {title: 'Nodes', number: true, by: ({vehicle}) =>
     isInMemory(vehicle) ? Number(vehicle.nodeCount) : NaN,
   cell: ({vehicle}) => isInMemory(vehicle) ? count(vehicle.nodeCount) : '–'},
  {title: 'Travelled', number: true, by: ({vehicle}) =>
     isInMemory(vehicle) ? vehicle.travelledMeters : NaN, cell: ({vehicle}) =>
     isInMemory(vehicle) ? length(vehicle.travelledMeters) : '–'},
  {title: 'Closures', number: true,
   by: ({vehicle}) => Number(vehicle.loopClosureCount),
   cell: ({vehicle}) => count(vehicle.loopClosureCount)},
  {title: 'Inflation', number: true,
   by: ({vehicle}) => vehicle.consistency?.inflation ?? NaN, cell: ({vehicle}) =>
     vehicle.consistency ? fixed(vehicle.consistency.inflation, 2) : '–'},
  {title: 'Findings', by: ({vehicle}) => vehicle.findings.length, cell: ({vehicle}) =>
     vehicle.findings.map(({code, message}) => (
       <span key={code} title={message}>{words(FindingCode[code])} </span>))},
  {title: 'Last pose', cell: ({lastPose}) =>
     lastPose ? positionText(lastPose) : ''},
  {title: 'Labels', cell: ({vehicle}) =>
     Object.entries(vehicle.labels).map(([key, value]) => (
       <span key={key} class="label">{value ? `${key}=${value}` : key}</span>
     ))},
];

/** Lists hold the size of a graph only while it is in the server's memory. */
function isInMemory({nodeCount, durableSequence}: FleetVehicle['vehicle']):
    boolean {
  return nodeCount > 0n || durableSequence === 0n;
}

function isGeodetic({vehicle}: FleetVehicle): boolean {
  return vehicle.settings?.coordinateFrame === CoordinateFrame.GEODETIC;
}

interface PlacedVehicle extends Place {
  vehicle: FleetVehicle;
}

/** The vehicles whose place on the earth is known. */
function placedOf(vehicles: FleetVehicle[]): PlacedVehicle[] {
  const placed: PlacedVehicle[] = [];
  for (const vehicle of vehicles) {
    const {settings} = vehicle.vehicle;
    const last = vehicle.lastPose?.position;
    const position = last?.case === 'geodetic' ?
        last.value : settings?.geodeticOrigin;
    if (!isGeodetic(vehicle) || !position) continue;
    placed.push({vehicle, latitude: position.latitudeDegrees,
                 longitude: position.longitudeDegrees});
  }
  return placed;
}

/** The frame that was used before, as long as a metre is a metre in it. */
function frameFor(placed: PlacedVehicle[], before: Frame|undefined):
    Frame|undefined {
  if (placed.length === 0) return undefined;
  const [{latitude, longitude}] = placed;
  const isNear = before &&
      Math.abs(before.origin.latitude - latitude) < FRAME_DEGREES &&
      Math.abs(before.origin.longitude - longitude) < FRAME_DEGREES;
  return isNear ? before : mercatorFrame({latitude, longitude});
}

function tipOf({id, vehicle, activity}: FleetVehicle): string {
  const name = vehicle.displayName ? `${vehicle.displayName} (${id})` : id;
  return `${name}: ${activity}, ${count(vehicle.durableSequence)} poses`;
}

/** Geodetic vehicles in one frame; those with local frames have none in
 * common. */
function sceneOf(placed: PlacedVehicle[], frame: Frame|undefined): Scene {
  const groups: Array<[string, Colour, (v: FleetVehicle) => boolean]> = [
    ['Idle', 'vehicle', v => v.activity === 'idle'],
    ['Streaming', 'accepted', v => v.activity === 'streaming'],
    ['Refuses writes', 'rejected-by-gate',
     v => v.activity === 'data loss' || v.activity === 'damaged'],
  ];
  const all: number[] = [];
  const shapes = groups.map(([label, colour, belongs]) => {
    const members = placed.filter(({vehicle}) => belongs(vehicle));
    const positions = members.flatMap(place => frame!.toMap(place));
    all.push(...positions);
    return dots({id: label, label, colour, radiusPixels: 6,
                 things: {
                   link: i => `/vehicles/${members[i].vehicle.id}`,
                   tip: i => tipOf(members[i].vehicle),
                   key: i => members[i].vehicle.id,
                 }}, positions);
  }).filter(({positions}) => positions.length > 0);
  return {shapes, box: boxAround(all)};
}

export function FleetView() {
  const store = useMemo(() => new FleetStore(), []);
  useEffect(() => () => store.close(), []);
  const shown = useRef<MapSheet>();
  const frame = useRef<Frame>();
  const all = store.vehicles.value;
  const filters = query.value;
  const vehicles = useMemo(
      () => (all ?? []).filter(vehicle => matches(vehicle, filters)),
      [all, filters]);
  const placed = useMemo(() => placedOf(vehicles), [vehicles]);
  frame.current = frameFor(placed, frame.current);
  const scene = useMemo(() => sceneOf(placed, frame.current), [placed]);
  const onMap = placed.length;
  const elsewhere = vehicles.length - onMap;
  const [pointed, setPointed] = useState<string>();
  useTitle('Fleet');
  const [visible, setVisible] = useState<FleetVehicle[]>([]);
  useEffect(() => store.show([...visible, ...vehicles.filter(isGeodetic)].map(
                ({vehicle}) => vehicle.name)), [visible, vehicles]);
  const field = (name: string) => (event: Event) =>
      setQuery(name, (event.target as HTMLInputElement).value || undefined);
  return (
    <>
      <div class="title">
        <h1>Fleet</h1>
        <p role="status">
          {all ? `${count(vehicles.length)} of ${count(all.length)} vehicles` :
                 'Asking the server…'}
        </p>
        <Export name="fleet" sheet={() => ({
          title: 'Fleet',
          map: shown.current,
          facts: vehicles.slice(0, 200).map(({id, vehicle, activity}) =>
              [id, `${activity}, ${count(vehicle.durableSequence)} poses, ${
                  count(vehicle.loopClosureCount)} closures`]),
        })} />
      </div>
      {store.error.value && <p class="error" role="status">
        {store.error.value}</p>}
      <form class="filters" role="search" onSubmit={e => e.preventDefault()}>
        <label>
          Search
          <input type="search" name="search" value={filters.get('search') ?? ''}
                 onInput={field('search')} placeholder="id, name, key=value" />
        </label>
        <label>
          State
          <select value={filters.get('state') ?? ''} onChange={field('state')}>
            <option value="">any</option>
            {ACTIVITIES.map(name => <option key={name}>{name}</option>)}
          </select>
        </label>
        <label class="check">
          <input type="checkbox" checked={filters.has('findings')}
                 onChange={e => setQuery('findings',
                     e.currentTarget.checked ? 'any' : undefined)} />
          with findings
        </label>
      </form>
      {onMap > 0 && (
        <MapView scene={scene} frame={frame.current} shownRef={shown}
                 pointed={pointed} onPoint={setPointed}
                 label={`Map of ${onMap} vehicles with geodetic positions; ` +
                        'the table has the same'} />
      )}
      {elsewhere > 0 && (
        <p class="hint">
          {count(elsewhere)} of these vehicles {elsewhere === 1 ? 'has' :
          'have'} a local frame of {elsewhere === 1 ? 'its' : 'their'} own,
          whose place on a common map is not known.
        </p>
      )}
      <Table label="Vehicles" columns={COLUMNS} rows={vehicles}
             keyOf={({id}) => id}
             onVisible={setVisible} pointed={pointed} onPoint={setPointed}
             empty={all ? (all.length > 0 ? 'No vehicle is like that.' :
                           'There is no vehicle that you may read.') : ''} />
      <p class="hint">
        – stands for what the server says only of vehicles in its memory.
        A vehicle is streaming if poses came within the last 10 s.
      </p>
    </>
  );
}
