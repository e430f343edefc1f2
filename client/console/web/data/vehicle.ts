// The state of one vehicle as the page knows it, kept up to date while somebody looks.
import {equals} from '@bufbuild/protobuf';
import {Code, ConnectError} from '@connectrpc/connect';
import {batch, computed, signal} from '@preact/signals';

import type {Recording} from '../../gen/revisit/v1/recording_pb.js';
import {type Vehicle, VehicleSettingsSchema} from
    '../../gen/revisit/v1/vehicle_pb.js';
import {CandidateSource} from './candidates.js';
import {allPages, credentials, messageOf, repeat, service, token} from
    './client.js';
import {type Decision, DecisionBook, keyOfPair, type Pair} from
    './decisions.js';
import {checkNodes, type Graph, GraphLoader, nodeAt, poseToAsk} from
    './graph.js';
import {place, type PlacedRecording, recordingOf, tiesOf} from
    './recordings.js';

const POLL_MILLISECONDS = 1000;
/** A vehicle may have as many recordings, so that one call tells of all. */
const MOST_RECORDINGS = 1000;

/** Searches at most so many poses, until somebody asks for more. */
export const SEARCHES_AT_ONCE = 100;

/** Whether nodes that were there before are elsewhere now. */
function wasRevised(before: Graph, after: Graph): boolean {
  if (after.size < before.size) return true;
  for (let i = 0; i < before.size; ++i) {
    if (before.x[i] !== after.x[i] || before.y[i] !== after.y[i]) return true;
  }
  return false;
}

/** All recordings, or none where the server is of a version that has none. */
async function listRecordings(parent: string): Promise<Recording[]> {
  try {
    return await allPages(
        pageToken => service.listRecordings(
            {parent, pageToken, pageSize: MOST_RECORDINGS}),
        page => page.recordings);
  } catch (error) {
    if (ConnectError.from(error).code === Code.Unimplemented) return [];
    throw error;
  }
}

export class VehicleStore {
  readonly name: string;
  readonly vehicle = signal<Vehicle|undefined>(undefined);
  /** In the frame of the last recording, as far as that is known: see
   * Placement. */
  readonly graph = signal<Graph|undefined>(undefined);
  /** The eldest first; empty for a vehicle that has only one. */
  readonly recordings = signal<readonly PlacedRecording[]>([]);
  /** Nodes that have come of an export that is under way; else undefined. */
  readonly loading = signal<number|undefined>(undefined);
  readonly error = signal<string|undefined>(undefined);
  readonly decisions: DecisionBook;
  /** At how many checks the views may search. */
  readonly searches = signal(SEARCHES_AT_ONCE);
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

  /** The pose to ask at, by the query that the server then takes. */
  private readonly askedFor = computed(() => {
    const graph = this.graph.value;
    return new Map(graph ? this.checks.value.map(
        ({pose}) => [graph.sequence[nodeAt(graph, pose)], pose]) : []);
  });
  private readonly loader = new GraphLoader();
  private readonly ends: Array<() => void> = [];
  private listed = '';
  /** The graph as it came, each recording in its own frame. */
  private own: Graph|undefined;
  private listedRecordings: Recording[] = [];
  /** The tiesOf() the graph for which these were listed. */
  private ties = '';

  constructor(readonly id: string) {
    this.name = `vehicles/${id}`;
    this.candidates = new CandidateSource(this.name);
    this.decisions = new DecisionBook(this.name, () => {
      this.candidates.outdate();
      this.refresh().catch(() => undefined);
    });
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
      this.decisions.drafts.open(vehicle!.uid);
      if (listed !== this.listed) {
        const changed = await this.decisions.read();
        if (changed && this.listed !== '') this.candidates.outdate();
        if (changed !== undefined) this.listed = listed;
      }
      const settings = this.vehicle.value?.settings;
      if (settings && !equals(VehicleSettingsSchema, settings,
                              vehicle!.settings!)) {
        this.candidates.outdate();
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

  private async refreshGraph(): Promise<void> {
    const {value: vehicle} = this.vehicle;
    if (!vehicle || Number(vehicle.revision) === this.graph.value?.revision) {
      return;
    }
    try {
      const before = this.own;
      const own = await this.loader.load(
          this.name, credentials(), before,
          nodes => this.loading.value = nodes);
      const ties = tiesOf(own);
      if (ties !== this.ties) {
        this.listedRecordings = await listRecordings(this.name);
        this.ties = ties;
      }
      this.own = own;
      const {graph, recordings} = place(own, this.listedRecordings);
      batch(() => {
        this.graph.value = graph;
        this.recordings.value = recordings;
      });
      if (before && before.nodesId !== own.nodesId &&
          wasRevised(before, own)) {
        this.candidates.outdate();
      }
    } finally {
      this.loading.value = undefined;
    }
  }

  /** The pair at an address that no check has: one that was decided about by
   * the numbers of its poses. */
  decidedAt(asked: number, matched: number): Decision|undefined {
    const isCheck = this.checks.value.some(({pose}) => pose === asked);
    return isCheck ? undefined : this.decisions.all.value.find(
        made => keyOfPair(made) === keyOfPair({query: asked, matched}));
  }

  /** The pair that is found by asking at a pose: a search is made at the last
   * node at or before it. */
  pairAt(asked: number, matched: number): Pair {
    const graph = this.graph.value;
    const node = graph ? nodeAt(graph, asked) : -1;
    return {query: node < 0 ? asked : graph!.sequence[node], matched};
  }

  /** The address of a pair: that of the check that found it, if one did. */
  addressOf({query, matched}: Pair): string {
    const asked = this.askedFor.value.get(query) ?? query;
    return `/vehicles/${this.id}/candidates/${asked}-${matched}`;
  }

  /** The decision about a pair or, if there is none, about the same two places,
   * with both poses at most `upTo`: the server takes rejections to be about all
   * that is within 10 m along the path. */
  decisionAbout(pair: Pair, upTo = Infinity): Decision|undefined {
    const made = this.decisions.all.value.filter(({query}) => query <= upTo);
    return made.find(other => keyOfPair(other) === keyOfPair(pair)) ??
        made.find(other => this.areSamePlaces(pair, other));
  }

  /** Whether nobody has decided about a pair, or the same two places, nor is
   * about to: whoever decides faster than the network answers is not led back to
   * what was decided just now. */
  isOpen(pair: Pair): boolean {
    return !this.decisionAbout(pair) && !this.decisions.underWay.value.some(
        other => this.areSamePlaces(pair, other));
  }

  private areSamePlaces(pair: Pair, other: Pair): boolean {
    const graph = this.graph.value;
    const separation = Math.max(
        10, this.vehicle.value?.settings?.candidateSeparationMeters ?? 0);
    const near = (a: number, b: number) => {
      if (a === b) return true;
      if (!graph) return false;
      const [i, j] = [nodeAt(graph, a), nodeAt(graph, b)];
      const {value: recordings} = this.recordings;
      return i >= 0 && j >= 0 &&
          recordingOf(recordings, i) === recordingOf(recordings, j) &&
          Math.abs(graph.travelled[i] - graph.travelled[j]) <= separation;
    };
    return near(pair.query, other.query) && near(pair.matched, other.matched);
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
