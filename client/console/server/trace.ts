import {randomBytes} from 'node:crypto';

/** Version, trace, span, flags, and what later versions may add. */
const TRACE_PARENT = new RegExp(
    '^(?!ff)([0-9a-f]{2})-([0-9a-f]{32})-([0-9a-f]{16})-([0-9a-f]{2})(-.*)?$');
const REQUEST_ID = /^[\x21-\x7e]{1,128}$/;

/** Names one request in the logs of all who take part in it. */
export interface Trace {
  requestId: string;
  traceId: string;
  /** Of the caller's span; undefined where the trace begins here. */
  parentId: string|undefined;
  /** The header that leads revisitd to the console's own span. */
  traceParent: string;
}

interface TraceParent {
  traceId: string;
  parentId: string;
  flags: string;
}

/** Undefined for what W3C's Trace Context takes for malformed. */
function parse(header: string|undefined): TraceParent|undefined {
  const found = TRACE_PARENT.exec(header ?? '');
  if (!found) return undefined;
  const [, version, traceId, parentId, flags, more] = found;
  const isMalformed = /^0+$/.test(traceId) || /^0+$/.test(parentId) ||
      (version === '00' && more !== undefined);
  return isMalformed ? undefined : {traceId, parentId, flags};
}

/** Goes on with the caller's trace and request id, or begins them. A trace that
 * begins here is not marked as sampled: nobody here records spans. */
export function traceOf(traceParent: string|undefined,
                        requestId: string|undefined): Trace {
  const caller = parse(traceParent);
  const traceId = caller?.traceId ?? randomBytes(16).toString('hex');
  const spanId = randomBytes(8).toString('hex');
  return {
    requestId: requestId !== undefined && REQUEST_ID.test(requestId) ?
        requestId : randomBytes(8).toString('hex'),
    traceId,
    parentId: caller?.parentId,
    traceParent: `00-${traceId}-${spanId}-${caller?.flags ?? '00'}`,
  };
}
