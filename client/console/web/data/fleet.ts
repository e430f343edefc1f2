// All vehicles that the caller may read.
import {signal} from '@preact/signals';

import type {Pose} from '../../gen/revisit/v1/geometry_pb.js';
import {type Vehicle, VehicleState} from
    '../../gen/revisit/v1/vehicle_pb.js';
import {allPages, messageOf, repeat, service} from './client.js';

const POLL_MILLISECONDS = 2000;
const STREAMING_MILLISECONDS = 10_000;
const PAGE_SIZE = 1000;
const MOST_POSES_ASKED = 500;

export type Activity = 'streaming'|'idle'|'data loss'|'damaged';

export interface FleetVehicle {
  id: string;
  vehicle: Vehicle;
  activity: Activity;
  /** Undefined until it was asked for, or if there is none. */
  lastPose: Pose|undefined;
}

export class FleetStore {
  readonly vehicles = signal<FleetVehicle[]|undefined>(undefined);
  readonly error = signal<string|undefined>(undefined);
  /** Highest sequence of each vehicle, and when it was seen to have grown. */
  private readonly seen = new Map<string, {sequence: bigint, grown: number}>();
  private readonly poses = new Map<string, {sequence: bigint, pose: Pose}>();
  private shown: string[] = [];
  private listed: Vehicle[] = [];
  private readonly end = repeat(POLL_MILLISECONDS, () => this.refresh());

  close(): void {
    this.end();
  }

  /** Says whose last poses are wanted, the most urgent first. */
  show(names: string[]): void {
    this.shown = names.slice(0, MOST_POSES_ASKED);
    void this.refreshPoses();
  }

  private async refresh(): Promise<void> {
    try {
      this.listed = await allPages(
          pageToken => service.listVehicles({pageToken, pageSize: PAGE_SIZE}),
          page => page.vehicles);
      this.publish();
      this.error.value = undefined;
      await this.refreshPoses();
    } catch (error) {
      this.error.value = messageOf(error);
      throw error;
    }
  }

  private async refreshPoses(): Promise<void> {
    const {shown} = this;
    for (const name of shown) {
      // Somebody scrolled on, and others are wanted.
      if (shown !== this.shown) return;
      const sequence = this.seen.get(name)?.sequence ?? 0n;
      if (sequence === 0n || this.poses.get(name)?.sequence === sequence) {
        continue;
      }
      const {poses} = await service.listPoses({
        parent: name,
        firstSequence: sequence,
        pageSize: 1,
        readMask: {paths: ['sequence', 'stamp', 'local', 'geodetic']},
      }).catch(() => ({poses: []}));
      if (poses.length > 0) this.poses.set(name, {sequence, pose: poses[0]});
    }
    if (this.vehicles.value) this.publish();
  }

  private publish(): void {
    const now = Date.now();
    this.vehicles.value = this.listed.map(vehicle => {
      const {name, durableSequence: sequence} = vehicle;
      const before = this.seen.get(name);
      if (!before || before.sequence !== sequence) {
        this.seen.set(name, {sequence, grown: before ? now : -Infinity});
      }
      return {
        id: name.replace('vehicles/', ''),
        vehicle,
        activity: this.activityOf(vehicle, now),
        lastPose: this.poses.get(name)?.pose,
      };
    });
  }

  private activityOf(vehicle: Vehicle, now: number): Activity {
    if (vehicle.state === VehicleState.DATA_LOSS) return 'data loss';
    if (vehicle.state === VehicleState.DAMAGED) return 'damaged';
    const {grown} = this.seen.get(vehicle.name)!;
    return now - grown < STREAMING_MILLISECONDS ? 'streaming' : 'idle';
  }
}
