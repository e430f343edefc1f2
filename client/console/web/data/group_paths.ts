// The paths of a group's members, as few points of each as a map of many needs:
// which of them are read, and in which order.

/** A member's path, each recording in a frame of its own. */
export interface MemberPath {
  /** The vehicle's display name, or ''. */
  title: string;
  /** The vehicle's when it was read. */
  revision: bigint;
  travelled: number;
  x: Float64Array;
  y: Float64Array;
  /** Pose of each point, at or before it. */
  sequence: Float64Array;
  /** Whether the line leads from the point before to this one. */
  joined: Uint8Array;
  /** How far a node may lie from the line. */
  toleranceMeters: number;
  /** Whether the path goes on behind the points. */
  isCut: boolean;
  /** Where the poses that were asked for lie; undefined for those that are not
   * there. */
  poses: Map<number, [number, number]|undefined>;
}

/** Where paths come from. */
export interface PathSource {
  /** Reads the path of the vehicle with this id, and where these poses of it
   * lie. */
  read(id: string, poses: number[]): Promise<MemberPath>;
  /** The vehicle's revision now. */
  revision(id: string): Promise<bigint>;
  /** What went wrong, for people. */
  messageOf(error: unknown): string;
}

/** The members to read, the most urgent first, and the poses of each whose
 * places are wanted. */
export type Wanted = ReadonlyMap<string, ReadonlySet<number>>;

/** Keeps the paths that are wanted, and no others. One is read at a time. */
export class PathBook {
  /** By the member's id. */
  readonly paths = new Map<string, MemberPath>();
  /** Why the path of a member could not be read. */
  readonly errors = new Map<string, string>();
  private wanted: Wanted = new Map();
  private isReading = false;
  /** How many were compared with what the server has. */
  private compared = 0;

  /** `changed` is called whenever paths or errors have changed; nothing is read
   * while `mayRead` says no. */
  constructor(private readonly source: PathSource,
              private readonly mayRead: () => boolean,
              private readonly changed: () => void) {}

  want(wanted: Wanted): Promise<void> {
    this.wanted = wanted;
    for (const known of [this.paths, this.errors]) {
      for (const id of known.keys()) {
        if (!wanted.has(id)) known.delete(id);
      }
    }
    this.changed();
    return this.proceed();
  }

  /** Reads what is wanted and not here. */
  async proceed(): Promise<void> {
    if (this.isReading) return;
    this.isReading = true;
    try {
      while (this.mayRead()) {
        const next = [...this.wanted].find(wanted => this.isDue(wanted));
        if (!next) return;
        await this.read(...next);
      }
    } finally {
      this.isReading = false;
    }
  }

  /** Reads one member anew if it has changed since, or could not be read: each
   * in its turn. */
  async renewNext(): Promise<void> {
    const ids = [...this.wanted.keys()];
    if (this.isReading || ids.length === 0 || !this.mayRead()) return;
    const id = ids[this.compared++ % ids.length];
    const path = this.paths.get(id);
    if (path && await this.source.revision(id) === path.revision) return;
    const poses = this.wanted.get(id);
    if (this.isReading || !poses) return;
    this.isReading = true;
    try {
      this.errors.delete(id);
      await this.read(id, poses);
    } finally {
      this.isReading = false;
    }
    await this.proceed();
  }

  private isDue([id, poses]: [string, ReadonlySet<number>]): boolean {
    if (this.errors.has(id)) return false;
    const path = this.paths.get(id);
    return !path || [...poses].some(pose => !path.poses.has(pose));
  }

  private async read(id: string, poses: ReadonlySet<number>): Promise<void> {
    try {
      const path = await this.source.read(id, [...poses]);
      if (this.wanted.has(id)) this.paths.set(id, path);
    } catch (error) {
      if (this.wanted.has(id)) {
        this.errors.set(id, this.source.messageOf(error));
      }
    }
    this.changed();
  }
}
