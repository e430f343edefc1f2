import {Code, ConnectError, type Transport} from '@connectrpc/connect';

import {errorInfoOf, isAway} from '../shared/error_info.js';
import type {Watch} from './watch.js';

/** A server, and whether it is there. */
export interface Server {
  transport: Transport;
  watch: Watch;
}

/** How often one call goes to another server than the last one. */
const MOST_HOPS = 3;
const MOST_OWNERS = 10_000;
/** The header by which the Envoy of a cluster sends a call to an owner. */
const OWNER_HEADER = 'x-revisit-owner';

/** Where one attempt of a call goes, and what it says besides. */
export interface Route {
  transport: Transport;
  headers: Array<[string, string]>;
  /** To be called at each part of an answer. */
  heard: () => void;
}

function ownerSaidBy(error: unknown): string|undefined {
  const info = errorInfoOf(error);
  return info?.reason === 'NOT_OWNER' ?
      info.metadata.get('owner') || undefined : undefined;
}

/** The id of the vehicle that a request is about; undefined for none, and for
 * all of them (`vehicles/-`). */
export function vehicleOf(request: object): string|undefined {
  const {name, parent, vehicle} = request as Record<string, unknown>;
  for (const value of [name, parent, vehicle]) {
    const found = typeof value === 'string' &&
        /^vehicles\/([^/]+)/.exec(value);
    if (found) return found[1] === '-' ? undefined : found[1];
  }
  return undefined;
}

/**
 * The servers of one store. Calls go to the first of them, until it answers
 * NOT_OWNER: then, and from then on, those about that vehicle go to its owner.
 * An owner is connected to only if it is one of the addresses that the console
 * was given, whatever an answer says; to others calls go by way of the first
 * address, with the header that leads them on where that is the cluster's
 * Envoy.
 */
export class Cluster {
  /** Address of the owner, by the vehicle's id; the eldest first. */
  private readonly owners = new Map<string, string>();
  private readonly byAddress: Map<string, Server>;
  /** All servers that were given, the first one first. */
  readonly servers: readonly Server[];

  /** There is an address at least. */
  constructor(addresses: readonly string[],
              connect: (address: string) => Server) {
    this.byAddress =
        new Map(addresses.map(address => [address, connect(address)]));
    this.servers = [...this.byAddress.values()];
  }

  /** Makes attempts of a call, which is about this vehicle, until one of them
   * reaches the vehicle's owner, or none will. */
  async call<T>(vehicle: string|undefined,
                attempt: (route: Route) => Promise<T>): Promise<T> {
    for (let hop = 0;; ++hop) {
      const asked = vehicle === undefined ? undefined :
                                            this.owners.get(vehicle);
      const server = this.serverOf(asked);
      try {
        server.watch.check();
        const answer = await attempt(this.routeTo(server, asked));
        server.watch.hear();
        return answer;
      } catch (error) {
        if (!isAway(error)) server.watch.hear();
        if (vehicle === undefined) throw error;
        const owner = ownerSaidBy(error);
        if (owner !== undefined) {
          this.remember(vehicle, owner);
          // Nothing was changed by a call that ended so. Whoever names the
          // same owner again does not lead there.
          if (owner !== asked && hop < MOST_HOPS) continue;
        } else if (ConnectError.from(error).code === Code.Unavailable) {
          this.owners.delete(vehicle);
        }
        throw error;
      }
    }
  }

  private serverOf(owner: string|undefined): Server {
    const direct = owner === undefined ? undefined :
                                         this.byAddress.get(owner);
    return direct ?? this.servers[0];
  }

  private routeTo({transport, watch}: Server, owner: string|undefined): Route {
    const isDirect = owner === undefined || this.byAddress.has(owner);
    return {
      transport,
      headers: isDirect ? [] :
          [[OWNER_HEADER, Buffer.from(owner).toString('base64')]],
      heard: () => watch.hear(),
    };
  }

  private remember(vehicle: string, owner: string): void {
    this.owners.delete(vehicle);
    this.owners.set(vehicle, owner);
    if (this.owners.size > MOST_OWNERS) {
      this.owners.delete(this.owners.keys().next().value!);
    }
  }
}
