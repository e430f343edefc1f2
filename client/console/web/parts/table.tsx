import {elementScroll, observeElementOffset, observeElementRect, Virtualizer}
    from '@tanstack/virtual-core';
import type {ComponentChildren} from 'preact';
import {useEffect, useLayoutEffect, useReducer, useRef} from 'preact/hooks';

export interface Column<Row> {
  title: string;
  cell: (row: Row) => ComponentChildren;
  /** Numbers are aligned at their right. */
  number?: boolean;
}

interface Props<Row> {
  label: string;
  columns: Array<Column<Row>>;
  rows: Row[];
  keyOf: (row: Row) => string;
  /** The row that is looked at: it is marked and scrolled into view. */
  current?: string;
  /** Whether the first column stays in view when the others are scrolled. */
  pinned?: boolean;
  /** Shown if there are no rows. */
  empty: ComponentChildren;
  /** Told which rows are in view. */
  onVisible?: (rows: Row[]) => void;
}

const ROW_PIXELS = 32;

/** A table of any length: only the rows in view are in the page. */
export function Table<Row>(
    {label, columns, rows, keyOf, current, pinned, empty, onVisible}:
        Props<Row>) {
  const [, redraw] = useReducer((n: number) => n + 1, 0);
  const scroller = useRef<HTMLDivElement>(null);
  const kept = useRef<Virtualizer<HTMLDivElement, Element>>();
  const options = {
    count: rows.length,
    estimateSize: () => ROW_PIXELS,
    overscan: 8,
    getScrollElement: () => scroller.current,
    scrollToFn: elementScroll,
    observeElementRect,
    observeElementOffset,
    onChange: () => redraw(0),
  };
  kept.current ??= new Virtualizer<HTMLDivElement, Element>(options);
  const virtualizer = kept.current;
  virtualizer.setOptions(options);
  useEffect(() => virtualizer._didMount(), []);
  useLayoutEffect(() => virtualizer._willUpdate());
  const index = current === undefined ?
      -1 : rows.findIndex(row => keyOf(row) === current);
  useEffect(() => {
    if (index >= 0) virtualizer.scrollToIndex(index, {align: 'auto'});
  }, [index]);

  const items = virtualizer.getVirtualItems();
  const visible = items.map(item => rows[item.index]);
  const visibleKeys = visible.map(keyOf).join();
  useEffect(() => onVisible?.(visible), [visibleKeys]);
  const above = items.length > 0 ? items[0].start : 0;
  const below = items.length > 0 ?
      virtualizer.getTotalSize() - items[items.length - 1].end : 0;
  return (
    <div class={pinned ? 'table pinned' : 'table'} ref={scroller} tabIndex={0}
         role="region" aria-label={label}>
      <table aria-rowcount={rows.length + 1} aria-label={label}>
        <thead>
          <tr aria-rowindex={1}>
            {columns.map(({title, number}) => (
              <th key={title} scope="col" class={number ? 'number' : ''}>
                {title}
              </th>
            ))}
          </tr>
        </thead>
        <tbody>
          {above > 0 && <tr class="space" style={{height: `${above}px`}} />}
          {items.map(({index: i}) => (
            <tr key={keyOf(rows[i])} aria-rowindex={i + 2}
                aria-current={i === index ? 'true' : undefined}>
              {columns.map(({title, cell, number}) => (
                <td key={title} class={number ? 'number' : ''}>
                  {cell(rows[i])}
                </td>
              ))}
            </tr>
          ))}
          {below > 0 && <tr class="space" style={{height: `${below}px`}} />}
        </tbody>
      </table>
      {rows.length === 0 && <p class="empty">{empty}</p>}
    </div>
  );
}
