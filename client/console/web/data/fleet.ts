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
  private readonly end = repeat(POLL_MILLISECONDS, () => this.refresh());

  close(): void {
    this.end();
  }

  /** Says whose last poses are wanted, the most urgent first. */
  show(names: string[]): void {
    this.shown = names.slice(0, MOST_POSES_ASKED);
  }

  private async refresh(): Promise<void> {
    try {
      const vehicles = await allPages(
          pageToken => service.listVehicles({pageToken, pageSize: PAGE_SIZE}),
          page => page.vehicles);
      this.publish(vehicles);
      await this.refreshPoses(vehicles);
      this.publish(vehicles);
      this.error.value = undefined;
    } catch (error) {
      this.error.value = messageOf(error);
      throw error;
    }
  }

  private async refreshPoses(vehicles: Vehicle[]): Promise<void> {
    const byName = new Map(vehicles.map(vehicle => [vehicle.name, vehicle]));
    for (const name of this.shown) {
      const sequence = byName.get(name)?.durableSequence ?? 0n;
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
  }

  private publish(vehicles: Vehicle[]): void {
    const now = Date.now();
    this.vehicles.value = vehicles.map(vehicle => {
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
