import {createHash} from 'node:crypto';

import {type Client, Code, ConnectError, createClient, type Transport} from
    '@connectrpc/connect';

import {PoseGraphService} from '../gen/revisit/v1/pose_graph_service_pb.js';
import {isAway} from '../shared/error_info.js';

const DEADLINE_MILLISECONDS = 2000;
/** How long an answer about a caller holds: a page asks for metrics every second
 * or two, and rights change rarely. */
const KEPT_MILLISECONDS = 10_000;
/** Callers whose answers are kept. Each takes some 200 bytes, and more than this
 * would be a flood: then the oldest answers go. */
const MOST_CALLERS = 1000;

interface Kept {
  answer: Promise<boolean>;
  /** By the clock of `performance`. */
  until: number;
}

/** Whether revisitd decided about the caller, rather than not at all. */
function isVerdict(error: unknown): boolean {
  const {code} = ConnectError.from(error);
  return code === Code.Unauthenticated || code === Code.PermissionDenied;
}

/**
 * Whether callers belong to no tenant, as revisitd itself says by its answer to
 * GetServerInfo. It is asked at most once in ten seconds about each caller, who
 * is known by the `authorization` of his requests: so all tabs of one share the
 * answer, a refusal too. That nobody answers is no answer: those who ask
 * meanwhile share it, and it is not kept.
 */
export class Standing {
  private readonly services: Array<Client<typeof PoseGraphService>>;
  private readonly kept = new Map<string, Kept>();

  /** The first server of those behind `transports` that answers says who a
   * caller is. */
  constructor(transports: readonly Transport[]) {
    this.services = transports.map(
        transport => createClient(PoseGraphService, transport));
  }

  /** Throws a refusal, or what the last server said if none knows. */
  isOverAllTenants(authorization: string|undefined): Promise<boolean> {
    // No secret is kept.
    const caller = createHash('sha256').update(authorization ?? '')
                       .digest('base64');
    const now = performance.now();
    const known = this.kept.get(caller);
    if (known && known.until > now) return known.answer;
    this.kept.delete(caller);
    const kept = {answer: this.ask(authorization),
                  until: now + KEPT_MILLISECONDS};
    this.kept.set(caller, kept);
    if (this.kept.size > MOST_CALLERS) {
      const [oldest] = this.kept.keys();
      this.kept.delete(oldest);
    }
    kept.answer.catch(error => {
      if (!isVerdict(error) && this.kept.get(caller) === kept) {
        this.kept.delete(caller);
      }
    });
    return kept.answer;
  }

  private async ask(authorization: string|undefined): Promise<boolean> {
    let failure: unknown;
    for (const service of this.services) {
      try {
        const {overAllTenants} = await service.getServerInfo({}, {
          timeoutMs: DEADLINE_MILLISECONDS,
          headers: authorization === undefined ? {} : {authorization},
        });
        return overAllTenants;
      } catch (error) {
        if (!isAway(error)) throw error;
        failure = error;
      }
    }
    throw failure;
  }
}
