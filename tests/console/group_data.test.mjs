// What the page of a group makes of members, frames, paths and links, without a
// browser.
import assert from 'node:assert/strict';
import {before, test} from 'node:test';

import {load} from './world.mjs';

const [SAME, DATUM, PROVISIONAL, KNOWN, NONE] = [1, 3, 4, 5, 6];
const [PLANAR_6, NOT_READY, STATE_SPACE] = [1, 1, 3];

let frames, links, paths, found, map, thinning, pyramid;
before(async () => {
  [frames, links, paths, found, map, thinning, pyramid] = await Promise.all([
    'web/data/group_frames.ts', 'web/data/group_links.ts',
    'web/data/group_paths.ts', 'web/data/group_found.ts',
    'web/views/group_map.ts', 'web/geometry/thin.ts',
    'web/geometry/pyramid.ts'].map(name => load(name)));
});

function transform(vehicle, firstSequence, frameState, pose, more = {}) {
  return {
    vehicle: `vehicles/${vehicle}`, frameState, loopClosureCount: 0,
    recording: `vehicles/${vehicle}/recordings/${firstSequence}`,
    framePose: pose && {xMeters: pose[0], yMeters: pose[1],
                        headingRadians: pose[2]},
    ...more};
}

/** A path whose points are poses 1, 2, ... 10 m apart along x. */
function straight(size, poses = [], more = {}) {
  return {
    title: '', revision: 1n, travelled: 10 * (size - 1),
    x: Float64Array.from({length: size}, (_, i) => 10 * i),
    y: new Float64Array(size),
    sequence: Float64Array.from({length: size}, (_, i) => i + 1),
    joined: Uint8Array.from({length: size}, (_, i) => i > 0 ? 1 : 0),
    toleranceMeters: 0, isCut: false,
    poses: new Map(poses.map(pose => [pose, [10 * (pose - 1), 0]])), ...more};
}

const link = (query, matched, more = {}) => ({
  name: `groups/g/loopClosures/${query}-${matched}`,
  query: {vehicle: query.split('@')[0], sequence: Number(query.split('@')[1])},
  matched: {vehicle: matched.split('@')[0],
            sequence: Number(matched.split('@')[1])},
  measurement: undefined, note: '', time: NaN, by: '', ...more});

const near = (got, wanted, what) => {
  assert.equal(got.length, wanted.length, what);
  wanted.forEach((value, i) => assert.ok(
      Math.abs(got[i] - value) < 1e-6, `${what}: ${got} for ${wanted}`));
};

test('a pose is in the last recording that begins at or before it', () => {
  const all = frames.framesOf([
    transform('a', 101, KNOWN, [1, 0, 0]), transform('a', 1, NONE),
    transform('b', 1, SAME, [0, 0, 0])]);
  const at = (id, sequence) => frames.frameAt(all.get(id), sequence);
  assert.equal(at('a', 100).firstSequence, 1);
  assert.equal(at('a', 101).firstSequence, 101);
  assert.equal(at('a', 9000).state, KNOWN);
  assert.equal(at('b', 0), undefined);
  assert.equal(at('c', 5), undefined);
  // One recording that is placed is enough to be on the map.
  assert.deepEqual(['a', 'b', 'c'].map(id => frames.isOnMap(all.get(id))),
                   [true, true, false]);
  assert.deepEqual([SAME, DATUM, PROVISIONAL, KNOWN, NONE].map(
      state => frames.isKnown({state})), [true, false, false, true, false]);
});

test('a frame that is doubted says where, in the frame of the map', () => {
  const [{doubt, motion}] = frames.framesOf([
    transform('a', 1, PROVISIONAL, [10, -3, Math.PI / 2], {
      frameReference: {xMeters: 2, yMeters: 1, headingRadians: 0},
      frameCovariance: {form: PLANAR_6, values: [9, 0, 0, 4, 0, 0.01]}}),
  ]).get('a');
  near([doubt.x, doubt.y, ...doubt.covariance], [9, -1, 9, 0, 4], 'doubt');
  near(frames.onMap({motion}, 1, 0), [10, -2], 'a place');
  assert.equal(frames.onMap({motion: undefined}, 1, 0), undefined);
  assert.equal(frames.onMap(undefined, 1, 0), undefined);
});

test('a frame that fixes tie without any error is known', () => {
  const tied = (values, more) => frames.framesOf([
    transform('a', 1, DATUM, [10, 0, 0], {
      frameReference: {xMeters: 0, yMeters: 0, headingRadians: 0},
      frameCovariance: {form: PLANAR_6, values}, ...more})]).get('a')[0];
  assert.equal(frames.isKnown(tied([0, 0, 0, 0, 0, 0])), true);
  assert.equal(map.frameText(tied([0, 0, 0, 0, 0, 0])),
               'exactly, by datums or fixes');
  for (const values of [[1, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 1]]) {
    assert.equal(frames.isKnown(tied(values)), false);
    assert.match(map.frameText(tied(values)), /^to within/);
  }
});

test('pages of frames are of one revision, or read anew', async () => {
  const pages = (...revisions) => {
    let calls = 0;
    return {list: async token => {
      const i = calls++;
      return {frameTransforms: [transform(`v${i}`, 1, NONE)],
              groupRevision: BigInt(revisions[i % revisions.length]),
              nextPageToken: token === '' ? 'more' : ''};
    }, calls: () => calls};
  };
  const steady = pages(4);
  assert.equal((await frames.ofOneRevision(steady.list)).length, 2);
  assert.equal(steady.calls(), 2);
  const changed = pages(4, 5, 5, 5);
  const read = await frames.ofOneRevision(changed.list);
  assert.deepEqual(read.map(({vehicle}) => vehicle),
                   ['vehicles/v2', 'vehicles/v3']);
  await assert.rejects(frames.ofOneRevision(pages(4, 5).list),
                       /changes faster/);
  await assert.rejects(frames.ofOneRevision(
      async () => ({frameTransforms: [], groupRevision: 1n,
                    nextPageToken: 'same'})), /does not go on/);
});

test('a link is told by its poses, with who added it when', () => {
  const made = links.asLink({
    name: 'groups/g/loopClosures/x',
    query: {vehicle: 'vehicles/a', sequence: 1200n},
    matched: {vehicle: 'vehicles/b', sequence: 7n},
    createTime: {seconds: 2n, nanos: 5e8}, note: 'seen',
    decidedBy: 'token:me'});
  assert.equal(links.posesName(made), 'a@1200 – b@7');
  assert.deepEqual([made.time, made.by, made.note, made.measurement],
                   [2500, 'token:me', 'seen', undefined]);
  assert.equal(made.kind, 'linked');
  assert.equal(links.asRejection({
    name: 'groups/g/rejectedCandidates/x', note: '', decidedBy: '',
    query: {vehicle: 'vehicles/a', sequence: 1n},
    matched: {vehicle: 'vehicles/b', sequence: 7n}}).kind, 'rejected');
});

test('a link is drawn where both of its frames are placed', () => {
  const all = frames.framesOf([
    transform('a', 1, SAME, [0, 0, 0]),
    transform('b', 1, KNOWN, [0, 30, 0]),
    transform('c', 1, PROVISIONAL, [0, 60, 0]), transform('d', 1, NONE)]);
  const read = new Map([
    ['a', straight(5, [2])], ['b', straight(5, [3])], ['c', straight(5, [4])],
    ['d', straight(5, [1])]]);
  const place = (...poses) =>
      map.placeLink(link(...poses), {frames: all, paths: read});
  const known = place('a@2', 'b@3');
  near(known.ends, [10, 0, 20, 30], 'ends');
  assert.equal(known.isKnown, true);
  near([known.apart], [Math.hypot(10, 30)], 'apart');
  assert.equal(place('b@3', 'c@4').isKnown, false);
  assert.equal(place('c@4', 'b@3').isKnown, false);
  // Nothing ties d; this pose of a was not asked for; nobody has read e.
  assert.equal(place('a@2', 'd@1'), undefined);
  assert.equal(place('a@3', 'b@3'), undefined);
  assert.equal(place('a@2', 'e@1'), undefined);
  assert.deepEqual(map.posesOfLinks([link('a@2', 'b@3'), link('b@9', 'a@2')]),
                   new Map([['a', new Set([2])], ['b', new Set([3, 9])]]));
});

test('a path is drawn by recordings: solid, dashed, and not where it is untied',
     () => {
  const all = frames.framesOf([
    transform('a', 1, KNOWN, [0, 0, Math.PI / 2]),
    transform('a', 4, PROVISIONAL, [100, 0, 0]), transform('a', 6, NONE)]);
  const path = straight(7);
  path.joined[3] = path.joined[5] = 0;
  const {known, estimated} = map.segmentsOf(path, all.get('a'));
  near(known, [0, 0, 0, 10, 0, 10, 0, 20], 'known');
  near(estimated, [130, 0, 140, 0], 'estimated');
});

test('the scene has each member in its colour, named, and boxes what is placed',
     () => {
  const members = ['a', 'b', 'c', 'lost'];
  const all = frames.framesOf([
    transform('a', 1, SAME, [0, 0, 0]), transform('b', 1, KNOWN, [0, 30, 0]),
    transform('c', 1, DATUM, [0, 60, 0]), transform('lost', 1, NONE)]);
  const read = new Map([
    ['a', straight(5, [2])], ['b', straight(5, [3], {title: 'Bus'})],
    ['c', straight(5, [1])], ['lost', straight(50, [4])]]);
  const scene = {members, frames: all, paths: read};
  const placed = [link('a@2', 'b@3'), link('a@2', 'c@1')].map(
      one => map.placeLink(one, scene));
  const {shapes, box, names} = map.sceneOfGroup(scene, placed);
  assert.deepEqual(box, {left: 0, right: 40, bottom: 0, top: 60});
  assert.deepEqual(names.map(({text, colour}) => [text, colour]),
                   [['a', 'path'], ['Bus', 'recording-1'],
                    ['c', 'recording-2']]);
  const by = label => shapes.find(shape => shape.label.startsWith(label));
  assert.equal(by('a, 40 m').dash, undefined);
  assert.equal(by('Bus, 40 m').colour, 'recording-1');
  assert.deepEqual(by('c, 40 m').dash, [8, 4]);
  assert.match(by('c, 40 m').label, /by datums or fixes/);
  assert.equal(by('lost'), undefined);
  const view = {x: 0, y: 0, metersPerPixel: 1, width: 100, height: 100};
  assert.equal(by('Link of two known').dash, undefined);
  near([...by('Link of two known').segmentsIn(view)], [10, 0, 20, 30], 'link');
  assert.deepEqual(by('Link of frames that').dash, [8, 4]);
  // Both ends of a link are the link, also where its line has no length.
  const ends = shapes.find(({id}) => id === 'ends true');
  assert.deepEqual([0, 1].map(i => ends.things.key(i)),
                   Array(2).fill(placed[0].link.name));
  const {things} = by('Bus, 40 m');
  assert.deepEqual([things.key(0), things.tip(3), things.link(0)],
                   ['b', 'Bus', '/vehicles/b']);
});

test('members of one colour are told apart by what is pointed at', () => {
  const members = Array.from({length: 12}, (_, i) => `v${i}`);
  const scene = {
    members,
    frames: frames.framesOf(members.map(
        (id, i) => transform(id, 1, i === 0 ? SAME : KNOWN, [0, 30 * i, 0]))),
    paths: new Map(members.map((id, i) => [id, straight(3 + i)]))};
  const {shapes} = map.sceneOfGroup(scene, []);
  const strand = shapes.find(({id}) => /^members path/.test(id));
  assert.match(strand.label, /^v0, 20 m; v5, 70 m; v10, 120 m$/);
  const keys = Array.from({length: 2 + 7 + 12}, (_, i) => strand.things.key(i));
  assert.deepEqual(keys, [...Array(2).fill('v0'), ...Array(7).fill('v5'),
                          ...Array(12).fill('v10')]);
  assert.match(shapes.find(({id}) => /^members recording-1/.test(id)).label,
               /v1.*v6.*v11/);
});

test('a link of a search is found again, whichever way round it was added',
     () => {
  const set = {candidates: [
    {rank: 1, query: {sequence: 90n}, matched: {sequence: 7n},
     matchedVehicle: 'vehicles/b'},
    {rank: 2, query: {sequence: 90n}, matched: {sequence: 8n},
     matchedVehicle: ''}]};
  const [across, own] = found.foundIn('a', set);
  assert.deepEqual(across.matched, {vehicle: 'b', sequence: 7});
  assert.deepEqual([across.isAcross, own.isAcross, own.matched.vehicle],
                   [true, false, 'a']);
  for (const [list, wanted] of [
    [[link('a@90', 'b@7')], true], [[link('b@7', 'a@90')], true],
    [[link('a@90', 'b@8')], false], [[link('a@7', 'b@90')], false],
    [[link('a@90', 'c@7')], false], [[], false]]) {
    assert.equal(found.decisionOf(list, across) !== undefined, wanted);
  }
  const partial = reason => found.isPartial({unsearched: [{reason}]});
  assert.deepEqual([partial(NOT_READY), partial(STATE_SPACE)], [true, false]);
});

/** A book whose source says what was read, and when it has to wait. */
function bookOf(more = {}) {
  const read = [];
  const revisions = new Map();
  const source = {
    read: async (id, poses) => {
      read.push(`${id} ${poses.join()}`);
      return straight(3, poses, {revision: revisions.get(id) ?? 1n});
    },
    revision: async id => revisions.get(id) ?? 1n,
    messageOf: error => error.message, ...more};
  let open = true;
  const book = new paths.PathBook(source, () => open, () => undefined);
  return {book, read, revisions, source, setOpen: value => open = value};
}

const wanted = (...members) => new Map(members.map(
    ([id, ...poses]) => [id, new Set(poses)]));

test('paths are read in the order that is wanted, once, and dropped', async () => {
  const {book, read} = bookOf();
  await book.want(wanted(['b', 4], ['a']));
  assert.deepEqual(read, ['b 4', 'a ']);
  await book.want(wanted(['a'], ['b', 4]));
  assert.equal(read.length, 2);
  // A new link names another pose of b: its place has to be read.
  await book.want(wanted(['a'], ['b', 4, 5]));
  assert.deepEqual(read.slice(2), ['b 4,5']);
  await book.want(wanted(['b', 5]));
  assert.deepEqual([...book.paths.keys()], ['b']);
  assert.equal(read.length, 3);
});

test('a pose that is not there is asked for once', async () => {
  const {book, read, source} = bookOf();
  source.read = async (id, poses) => {
    read.push(id);
    return straight(3, [], {poses: new Map(poses.map(
        pose => [pose, undefined]))});
  };
  await book.want(wanted(['a', 4]));
  await book.want(wanted(['a', 4]));
  assert.deepEqual(read, ['a']);
});

test('nothing is read while nobody looks', async () => {
  const {book, read, setOpen} = bookOf();
  setOpen(false);
  await book.want(wanted(['a'], ['b']));
  await book.renewNext();
  assert.deepEqual(read, []);
  setOpen(true);
  await book.proceed();
  assert.deepEqual(read, ['a ', 'b ']);
});

test('a path that cannot be read says why, holds up no other, and is tried again',
     async () => {
  const {book, read, source} = bookOf();
  const works = source.read;
  source.read = async (id, poses) => {
    if (id === 'a') throw new Error('gone');
    return works(id, poses);
  };
  await book.want(wanted(['a'], ['b']));
  assert.deepEqual([...book.errors], [['a', 'gone']]);
  assert.deepEqual(read, ['b ']);
  source.read = works;
  await book.renewNext();
  assert.deepEqual([[...book.errors], [...book.paths.keys()]],
                   [[], ['b', 'a']]);
});

test('a path is read anew when its vehicle has changed, each in its turn',
     async () => {
  const {book, read, revisions} = bookOf();
  await book.want(wanted(['a'], ['b', 2]));
  read.length = 0;
  await book.renewNext();
  await book.renewNext();
  assert.deepEqual(read, []);
  revisions.set('b', 2n);
  await book.renewNext();
  assert.deepEqual(read, []);
  await book.renewNext();
  assert.deepEqual(read, ['b 2']);
  assert.equal(book.paths.get('b').revision, 2n);
});

test('a path that is wanted no more when it comes is not kept', async () => {
  const {book, source} = bookOf();
  const gates = [];
  source.read = (id, poses) => new Promise(
      done => gates.push(() => done(straight(3, poses))));
  const first = book.want(wanted(['a']));
  const second = book.want(wanted(['b']));
  gates[0]();
  while (gates.length < 2) await new Promise(done => setTimeout(done, 1));
  gates[1]();
  await Promise.all([first, second]);
  assert.deepEqual([...book.paths.keys()], ['b']);
});

/** A winding path of 2 m steps that is cut at some nodes. */
function winding(size, ...cuts) {
  const path = {x: new Float64Array(size), y: new Float64Array(size),
                joined: new Uint8Array(size).fill(1)};
  for (const cut of [0, ...cuts]) path.joined[cut] = 0;
  let heading = 0;
  for (let i = 1; i < size; ++i) {
    heading += 0.05 * Math.sin(i / 30) + 0.04 * Math.sin(i / 7);
    path.x[i] = path.x[i - 1] + 2 * Math.cos(heading);
    path.y[i] = path.y[i - 1] + 2 * Math.sin(heading);
  }
  return path;
}

test('a thin path has few points, and leaves no node far away', () => {
  const {x, y, joined} = winding(30_000, 7000);
  const all = pyramid.buildPyramid(x, y, joined);
  const {nodes, joined: joins, toleranceMeters, isCut} =
      thinning.thin(all, 1000);
  assert.ok(nodes.length <= 1000 && nodes.length > 100, `${nodes.length}`);
  assert.equal(isCut, false);
  // It begins anew at the cut only, also where chunks meet.
  assert.deepEqual([...nodes].filter((_, k) => !joins[k]), [0, 7000]);
  assert.ok([...nodes].every((node, k) => k === 0 || node > nodes[k - 1]));
  let k = 0;
  for (let i = 0; i < x.length; i += 3) {
    while (nodes[k + 1] <= i) ++k;
    if (nodes[k] === i || k + 1 === nodes.length) continue;
    const [a, b] = [nodes[k], nodes[k + 1]];
    const [dx, dy] = [x[b] - x[a], y[b] - y[a]];
    const along = Math.min(1, Math.max(0, ((x[i] - x[a]) * dx +
        (y[i] - y[a]) * dy) / (dx * dx + dy * dy)));
    const far = Math.hypot(x[a] + along * dx - x[i], y[a] + along * dy - y[i]);
    assert.ok(joins[k + 1] === 0 || far <= 1.5 * toleranceMeters + 1e-9,
              `${far} m at node ${i}`);
  }
});

test('a path of many gaps is cut at the bound, and says so', () => {
  const cuts = Array.from({length: 499}, (_, i) => 6 * (i + 1));
  const {x, y, joined} = winding(3000, ...cuts);
  const all = pyramid.buildPyramid(x, y, joined);
  const {nodes, isCut} = thinning.thin(all, 100);
  assert.equal(nodes.length, 100);
  assert.equal(isCut, true);
  assert.equal(thinning.thin(all, 3000).isCut, false);
});
