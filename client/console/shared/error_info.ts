import {BinaryReader} from '@bufbuild/protobuf/wire';
import {Code, ConnectError} from '@connectrpc/connect';

/** The content of a google.rpc.ErrorInfo that is used here. */
export interface ErrorInfo {
  reason: string;
  metadata: Map<string, string>;
}

const TYPE = 'google.rpc.ErrorInfo';

function readEntry(reader: BinaryReader): [string, string] {
  const end = reader.pos + reader.uint32();
  let [key, value] = ['', ''];
  while (reader.pos < end) {
    const [field, wire] = reader.tag();
    if (field === 1) {
      key = reader.string();
    } else if (field === 2) {
      value = reader.string();
    } else {
      reader.skip(wire);
    }
  }
  return [key, value];
}

// Read by hand, since neither Debian nor Connect ships the message's proto.
function decode(bytes: Uint8Array): ErrorInfo {
  const info: ErrorInfo = {reason: '', metadata: new Map()};
  const reader = new BinaryReader(bytes);
  while (reader.pos < reader.len) {
    const [field, wire] = reader.tag();
    if (field === 1) {
      info.reason = reader.string();
    } else if (field === 3) {
      info.metadata.set(...readEntry(reader));
    } else {
      reader.skip(wire);
    }
  }
  return info;
}

/** Undefined if the error has none. */
export function errorInfoOf(error: unknown): ErrorInfo|undefined {
  for (const detail of ConnectError.from(error).details) {
    if (!('type' in detail) || detail.type !== TYPE) continue;
    try {
      return decode(detail.value);
    } catch {
      return undefined;
    }
  }
  return undefined;
}

/** The codes of a server that does not answer. A connection that was reset is
 * reported like a call that the caller gave up. */
const AWAY = new Set([Code.Unavailable, Code.DeadlineExceeded, Code.Canceled]);

/** Whether this error says that the server was not reached. */
export function isAway(error: unknown): boolean {
  return AWAY.has(ConnectError.from(error).code);
}
