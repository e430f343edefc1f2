import {elementScroll, observeElementOffset, observeElementRect, Virtualizer}
    from '@tanstack/virtual-core';
import type {ComponentChildren} from 'preact';
import {useEffect, useLayoutEffect, useMemo, useReducer, useRef, useState} from
    'preact/hooks';

export interface Column<Row> {
  title: string;
  cell: (row: Row) => ComponentChildren;
  /** Numbers are aligned at their right. */
  number?: boolean;
  /** Rows are sorted by this where somebody chooses the column. */
  by?: (row: Row) => number|string;
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
  /** Key of a row that somebody points at elsewhere. */
  pointed?: string;
  /** Told the key of the row that somebody points at here, or has moved the
   * focus into. */
  onPoint?: (key: string|undefined) => void;
  /** A class of the row, for its looks. */
  rowClass?: (row: Row) => string;
  /** Told the key of a row that was clicked. */
  onPick?: (key: string) => void;
  /** Told which rows are in view. */
  onVisible?: (rows: Row[]) => void;
}

const ROW_PIXELS = 32;

/** The column by which rows are sorted. */
interface Order {
  title: string;
  direction: 1|-1;
}

function sorted<Row>(rows: Row[], columns: Array<Column<Row>>,
                     order: Order|undefined): Row[] {
  const by = columns.find(({title}) => title === order?.title)?.by;
  if (!order || !by) return rows;
  const keys = new Map(rows.map(row => [row, by(row)]));
  return [...rows].sort((a, b) => {
    const [x, y] = [keys.get(a)!, keys.get(b)!];
    return order.direction * (typeof x === 'string' ?
        x.localeCompare(String(y), 'en', {numeric: true}) :
        // An unknown value comes last.
        (Number.isNaN(x) ? Infinity : x) - (Number.isNaN(y as number) ?
            Infinity : y as number) || 0);
  });
}

function Head<Row>({column: {title, number, by}, order, onOrder}: {
  column: Column<Row>, order: Order|undefined,
  onOrder: (order: Order|undefined) => void,
}) {
  const mine = order?.title === title ? order : undefined;
  // Upwards, downwards, then as it came.
  const next = () => onOrder(
      !mine ? {title, direction: 1} :
      mine.direction === 1 ? {title, direction: -1} : undefined);
  return (
    <th scope="col" class={number ? 'number' : ''} aria-sort={
        !mine ? undefined :
        mine.direction === 1 ? 'ascending' : 'descending'}>
      {by ? (
        <button type="button" onClick={next}>
          {title}
          <span aria-hidden="true">
            {mine ? mine.direction === 1 ? '▲' : '▼' : '↕'}
          </span>
        </button>
      ) : title}
    </th>
  );
}

/** A table of any length: only the rows in view are in the page. */
export function Table<Row>(
    {label, columns, rows: given, keyOf, current, pinned, empty, pointed,
     onPoint, onVisible, rowClass, onPick}: Props<Row>) {
  const [order, setOrder] = useState<Order>();
  const rows = useMemo(() => sorted(given, columns, order),
                       [given, columns, order]);
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

  // Rows that are pointed at on a map come into view, those pointed at here are.
  const pointedIndex = pointed === undefined ?
      -1 : rows.findIndex(row => keyOf(row) === pointed);
  useEffect(() => {
    const here = scroller.current!.matches(':hover, :focus-within');
    if (pointedIndex >= 0 && !here) {
      virtualizer.scrollToIndex(pointedIndex, {align: 'auto'});
    }
  }, [pointedIndex]);

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
            {columns.map(column => (
              <Head key={column.title} column={column} order={order}
                    onOrder={setOrder} />
            ))}
          </tr>
        </thead>
        <tbody>
          {above > 0 && <tr class="space" style={{height: `${above}px`}} />}
          {items.map(({index: i}) => (
            <tr key={keyOf(rows[i])} aria-rowindex={i + 2}
                class={[keyOf(rows[i]) === pointed ? 'pointed' : '',
                        rowClass?.(rows[i]) ?? ''].join(' ').trim() ||
                    undefined}
                onClick={() => onPick?.(keyOf(rows[i]))}
                onMouseEnter={() => onPoint?.(keyOf(rows[i]))}
                onMouseLeave={() => onPoint?.(undefined)}
                onFocusCapture={() => onPoint?.(keyOf(rows[i]))}
                onBlurCapture={() => onPoint?.(undefined)}
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
