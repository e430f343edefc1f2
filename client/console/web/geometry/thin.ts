// A path with few points: for maps of hundreds of paths, of which each is small.
import type {Pyramid} from './pyramid.js';

export interface ThinPath {
  /** The nodes that are kept, ascending. */
  nodes: Uint32Array;
  /** Whether the line leads from the point before to this one. */
  joined: Uint8Array;
  /** No node lies farther from the line than this and half as much again. */
  toleranceMeters: number;
  /** Whether it ends before the path does, because of too many gaps. */
  isCut: boolean;
}

/** The finest level of a pyramid that has at most so many points or, where none
 * has, so much of the coarsest. */
export function thin({levels, first}: Pyramid, most: number): ThinPath {
  const level = levels.find(({nodes}) => nodes.length <= most) ??
      levels[levels.length - 1];
  const kept: number[] = [];
  const joins: number[] = [];
  for (let c = 0; c < first.length; ++c) {
    for (let i = level.starts[c]; i < level.starts[c + 1]; ++i) {
      const node = level.nodes[i];
      // Chunks that are joined share a node.
      if (node === kept.at(-1)) continue;
      joins.push(i > level.starts[c] ? 1 : 0);
      kept.push(node);
    }
  }
  const isCut = kept.length > most;
  return {nodes: Uint32Array.from(kept.slice(0, most)),
          joined: Uint8Array.from(joins.slice(0, most)),
          toleranceMeters: level.toleranceMeters, isCut};
}
