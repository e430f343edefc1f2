// The state of one vehicle as the page knows it, kept up to date while somebody looks.
import {equals} from '@bufbuild/protobuf';
import {batch, computed, signal} from '@preact/signals';

import type {Candidate} from '../../gen/revisit/v1/candidate_pb.js';
import type {LoopClosure, RejectedCandidate} from
    '../../gen/revisit/v1/loop_closure_pb.js';
import {type Vehicle, VehicleSettingsSchema} from
    '../../gen/revisit/v1/vehicle_pb.js';
import {CandidateSource} from './candidates.js';
import {allPages, credentials, messageOf, repeat, service, token} from
    './client.js';
import {checkNodes, type Graph, GraphLoader, nodeAt, poseToAsk} from
    './graph.js';

const POLL_MILLISECONDS = 1000;
const PAGE_SIZE = 1000;

/** A loop closure or a rejected candidate. */
export interface Decision {
  kind: 'confirmed'|'rejected';
  /** The resource name. */
  name: string;
  querySequence: number;
  matchedSequence: number;
  note: string;
}

function asDecision(kind: Decision['kind'],
                    made: LoopClosure|RejectedCandidate): Decision {
  return {
    kind,
    name: made.name,
    querySequence: Number(made.querySequence),
    matchedSequence: Number(made.matchedSequence),
    note: made.note,
  };
}

/** Whether nodes that were there before are elsewhere now. */
function wasRevised(before: Graph, after: Graph): boolean {
  if (after.size < before.size) return true;
  for (let i = 0; i < before.size; ++i) {
    if (before.x[i] !== after.x[i] || before.y[i] !== after.y[i]) return true;
  }
  return false;
}

export class VehicleStore {
  readonly name: string;
  readonly vehicle = signal<Vehicle|undefined>(undefined);
  readonly graph = signal<Graph|undefined>(undefined);
  readonly closures = signal<LoopClosure[]>([]);
  readonly rejections = signal<RejectedCandidate[]>([]);
  /** Nodes that have come of an export that is under way; else undefined. */
  readonly loading = signal<number|undefined>(undefined);
  readonly error = signal<string|undefined>(undefined);
  /** Made here, and can be undone; the last one at the end. */
  readonly decisions = signal<Decision[]>([]);
  /** Whoever made them: the loop closures, then the rejections. */
  readonly allDecisions = computed(
      () => [...this.closures.value.map(made => asDecision('confirmed', made)),
             ...this.rejections.value.map(
                 made => asDecision('rejected', made))]);
  readonly candidates: CandidateSource;
  /** Poses at which checks fell due, by the graph that is here. */
  readonly checks = computed(() => {
    const graph = this.graph.value;
    const settings = this.vehicle.value?.settings;
    if (!graph || !settings) return [];
    const nodes = checkNodes(graph, settings.checkIntervalMeters!,
                             settings.sequenceLengthMeters!);
    return nodes.map(node => ({node, pose: poseToAsk(graph, node)}));
  });

  private readonly loader = new GraphLoader();
  private readonly ends: Array<() => void> = [];
  private listed = '';

  constructor(readonly id: string) {
    this.name = `vehicles/${id}`;
    this.candidates = new CandidateSource(this.name);
    this.ends.push(
        repeat(POLL_MILLISECONDS, () => this.refresh()),
        repeat(POLL_MILLISECONDS, () => this.refreshGraph()));
  }

  close(): void {
    for (const end of this.ends) end();
    this.loader.close();
    this.candidates.close();
  }

  /** Reads the vehicle and, if it has changed, what was decided about it. */
  async refresh(): Promise<void> {
    try {
      const {vehicle} = await service.getVehicle({name: this.name});
      const listed = `${vehicle!.uid} ${vehicle!.revision}`;
      if (listed !== this.listed) {
        await this.refreshDecisions();
        this.listed = listed;
      }
      const settings = this.vehicle.value?.settings;
      if (settings && !equals(VehicleSettingsSchema, settings,
                              vehicle!.settings!)) {
        this.candidates.askAnew();
      }
      batch(() => {
        this.vehicle.value = vehicle;
        this.error.value = undefined;
      });
    } catch (error) {
      this.error.value = messageOf(error);
      throw error;
    }
  }

  private async refreshDecisions(): Promise<void> {
    const parent = this.name;
    const [closures, rejections] = await Promise.all([
      allPages(pageToken => service.listLoopClosures(
                   {parent, pageToken, pageSize: PAGE_SIZE}),
               page => page.loopClosures),
      allPages(pageToken => service.listRejectedCandidates(
                   {parent, pageToken, pageSize: PAGE_SIZE}),
               page => page.rejectedCandidates),
    ]);
    const names = (items: Array<{name: string}>) =>
        items.map(item => item.name).join();
    const changed = this.listed !== '' &&
        (names(closures) !== names(this.closures.value) ||
         names(rejections) !== names(this.rejections.value));
    batch(() => {
      this.closures.value = closures;
      this.rejections.value = rejections;
    });
    if (changed) this.candidates.askAnew();
  }

  private async refreshGraph(): Promise<void> {
    const {value: vehicle} = this.vehicle;
    if (!vehicle || Number(vehicle.revision) === this.graph.value?.revision) {
      return;
    }
    try {
      const before = this.graph.value;
      const graph = await this.loader.load(
          {vehicle: this.name, origin: location.origin,
           headers: credentials()},
          nodes => this.loading.value = nodes);
      this.graph.value = graph;
      if (before && wasRevised(before, graph)) this.candidates.askAnew();
    } finally {
      this.loading.value = undefined;
    }
  }

  async confirm(candidate: Candidate, note: string): Promise<void> {
    const {loopClosure} = await service.addLoopClosure({
      parent: this.name,
      loopClosure: {
        querySequence: candidate.query!.sequence,
        matchedSequence: candidate.matched!.sequence,
        note,
      },
    });
    await this.decided(asDecision('confirmed', loopClosure!));
  }

  async reject(candidate: Candidate, note: string): Promise<void> {
    const {rejectedCandidate} = await service.rejectCandidate({
      parent: this.name,
      rejectedCandidate: {
        querySequence: candidate.query!.sequence,
        matchedSequence: candidate.matched!.sequence,
        note,
      },
    });
    await this.decided(asDecision('rejected', rejectedCandidate!));
  }

  private async decided(decision: Decision): Promise<void> {
    this.decisions.value = [
      ...this.decisions.value.filter(({name}) => name !== decision.name),
      decision,
    ];
    await this.refresh();
  }

  /** Deletes a loop closure or a rejection. */
  async withdraw(name: string): Promise<void> {
    if (name.includes('/loopClosures/')) {
      await service.deleteLoopClosure({name});
    } else {
      await service.deleteRejectedCandidate({name});
    }
    this.decisions.value =
        this.decisions.value.filter(decision => decision.name !== name);
    await this.refresh();
  }

  /** The loop closure or rejection that is about the same two places, if there
   * is one with both poses at most `upTo`: the server takes rejections to be,
   * within 10 m along the path. */
  decisionAbout(query: number, matched: number, upTo = Infinity):
      Decision|undefined {
    const graph = this.graph.value;
    const separation = Math.max(
        10, this.vehicle.value?.settings?.candidateSeparationMeters ?? 0);
    const near = (a: number, b: number) => {
      if (a === b) return true;
      if (!graph) return false;
      const [i, j] = [nodeAt(graph, a), nodeAt(graph, b)];
      return i >= 0 && j >= 0 &&
          Math.abs(graph.travelled[i] - graph.travelled[j]) <= separation;
    };
    return this.allDecisions.value.find(
        ({querySequence, matchedSequence}) => querySequence <= upTo &&
            near(query, querySequence) && near(matched, matchedSequence));
  }
}

let current: VehicleStore|undefined;

/** The store of a vehicle. There is one at a time, which all views of the
 * vehicle share; another vehicle or another token makes a new one. */
export function vehicleStore(id: string): VehicleStore {
  if (current?.id !== id) {
    current?.close();
    current = new VehicleStore(id);
  }
  return current;
}

/** Forgets the vehicle, when no view of one is shown any more. */
export function leaveVehicle(): void {
  current?.close();
  current = undefined;
}

token.subscribe(() => leaveVehicle());
