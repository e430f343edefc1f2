// Reads the paths of a group's members in a worker, as long as somebody looks.
import {ConnectError} from '@connectrpc/connect';
import {signal} from '@preact/signals';

import {credentials, idle, messageOf, repeat, service} from './client.js';
import {type MemberPath, PathBook, type Wanted} from './group_paths.js';

/** Points of one path: some 40 kB with what is drawn of it. */
const MOST_POINTS = 1000;
const RENEW_MILLISECONDS = 2000;
const PUBLISH_MILLISECONDS = 200;

export interface PathRequest {
  vehicle: string;
  origin: string;
  headers: Record<string, string>;
  mostPoints: number;
  /** Poses whose places are wanted exactly. */
  poses: number[];
}

export type PathMessage =
    {kind: 'path', path: MemberPath}|
    {kind: 'error', code: ConnectError['code'], message: string};

/** Reads one path at a time, so that the page stays smooth meanwhile. */
class PathWorker {
  private readonly worker = new Worker(
      new URL('./group_path_worker.ts', import.meta.url), {type: 'module'});

  read(id: string, poses: number[]): Promise<MemberPath> {
    return new Promise((resolve, reject) => {
      this.worker.onmessage = ({data}: MessageEvent<PathMessage>) => {
        if (data.kind === 'path') {
          resolve(data.path);
        } else {
          reject(new ConnectError(data.message, data.code));
        }
      };
      this.worker.onerror = event => reject(new Error(event.message));
      const request: PathRequest = {
        vehicle: `vehicles/${id}`, poses, headers: credentials(),
        origin: location.origin, mostPoints: MOST_POINTS};
      this.worker.postMessage(request);
    });
  }

  close(): void {
    this.worker.terminate();
  }
}

async function revisionOf(id: string): Promise<bigint> {
  const {vehicle} = await service.getVehicle({name: `vehicles/${id}`});
  return vehicle!.revision;
}

export class PathStore {
  /** By the member's id. */
  readonly paths = signal<ReadonlyMap<string, MemberPath>>(new Map());
  /** Why the path of a member could not be read. */
  readonly errors = signal<ReadonlyMap<string, string>>(new Map());
  private readonly worker = new PathWorker();
  private readonly book = new PathBook(
      {read: (id, poses) => this.worker.read(id, poses), revision: revisionOf,
       messageOf},
      () => !idle.value && !this.isClosed, () => this.publish());
  private isClosed = false;
  private publishing = false;
  private readonly ends = [
    idle.subscribe(() => void this.book.proceed()),
    repeat(RENEW_MILLISECONDS, () => this.book.renewNext()),
  ];

  close(): void {
    this.isClosed = true;
    for (const end of this.ends) end();
    this.worker.close();
  }

  want(wanted: Wanted): void {
    void this.book.want(wanted);
  }

  /** Shows what is known, at most a few times a second: hundreds of paths come
   * one after the other. */
  private publish(): void {
    if (this.publishing) return;
    this.publishing = true;
    setTimeout(() => {
      this.publishing = false;
      if (this.isClosed) return;
      this.paths.value = new Map(this.book.paths);
      this.errors.value = new Map(this.book.errors);
    }, PUBLISH_MILLISECONDS);
  }
}
