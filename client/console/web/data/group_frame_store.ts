// Asks where the members of a group lie, as long as somebody looks.
import {Code, ConnectError} from '@connectrpc/connect';
import {batch, signal} from '@preact/signals';

import {isReadingGroup, messageOf, repeat, service} from './client.js';
import {type Frames, framesOf, ofOneRevision} from './group_frames.js';

const POLL_MILLISECONDS = 5000;
const PAGE_SIZE = 1000;

export class FrameStore {
  /** Undefined until they are known in the frame of this member. */
  readonly frames = signal<Frames|undefined>(undefined);
  readonly error = signal<string|undefined>(undefined);
  /** Whether the server is of a version that does not tell. */
  readonly isUnknown = signal(false);
  /** Whether the server still reads the histories that it needs. */
  readonly isReading = signal(false);
  private reference: string|undefined;
  private version = '';
  private end: (() => void)|undefined;

  constructor(private readonly parent: string) {}

  /** Tells where members lie in the frame of this one's last recording; at once
   * where that, or the version of the group, is another one than before. */
  show(reference: string|undefined, version: string): void {
    if (reference === this.reference && version === this.version) return;
    if (reference !== this.reference) this.frames.value = undefined;
    this.reference = reference;
    this.version = version;
    this.end?.();
    this.end = reference === undefined ?
        undefined : repeat(POLL_MILLISECONDS, () => this.refresh());
  }

  close(): void {
    this.end?.();
    this.reference = undefined;
  }

  private async refresh(): Promise<void> {
    const {reference} = this;
    if (reference === undefined || this.isUnknown.value) return;
    try {
      const transforms = await ofOneRevision(
          pageToken => service.listFrameTransforms(
              {parent: this.parent, vehicle: `vehicles/${reference}`,
               allowPartial: true, pageToken, pageSize: PAGE_SIZE}));
      if (reference !== this.reference) return;
      batch(() => {
        this.frames.value = framesOf(transforms);
        this.error.value = undefined;
        this.isReading.value = false;
      });
    } catch (error) {
      if (reference !== this.reference) return;
      batch(() => {
        this.isUnknown.value =
            ConnectError.from(error).code === Code.Unimplemented;
        this.isReading.value = isReadingGroup(error);
        this.error.value = this.isUnknown.value || this.isReading.value ?
            undefined : messageOf(error);
      });
      throw error;
    }
  }
}
