// The text in which servers tell their metrics to Prometheus (version 0.0.4).

/** One number of a metric; histograms have one for each bucket. */
export interface MetricSample {
  name: string;
  labels: Record<string, string>;
  /** Null where the text says NaN, +Inf or -Inf. */
  value: number|null;
}

const SAMPLE = /^([a-zA-Z_:][a-zA-Z0-9_:]*)(?:\{(.*)\})?\s+(\S+)(?:\s+-?\d+)?$/;
const LABEL =
    /\s*([a-zA-Z_][a-zA-Z0-9_]*)\s*=\s*"((?:[^"\\]|\\.)*)"\s*(?:,|$)/y;
const ESCAPES: Record<string, string> = {'\\\\': '\\', '\\"': '"', '\\n': '\n'};
const NUMBER = /^[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?$/;
const NO_NUMBERS = new Set(['NaN', '+Inf', '-Inf', 'Inf']);

function labelsOf(text: string, line: string): Record<string, string> {
  const labels: Record<string, string> = {};
  let end = 0;
  while (end < text.length) {
    LABEL.lastIndex = end;
    const found = LABEL.exec(text);
    if (!found) throw new Error(`no labels of a metric: ${line}`);
    labels[found[1]] =
        found[2].replace(/\\./g, escape => ESCAPES[escape] ?? escape);
    end = LABEL.lastIndex;
  }
  return labels;
}

/** Reads the whole text; throws an Error that names a line that is none. */
export function parseMetrics(text: string): MetricSample[] {
  const samples: MetricSample[] = [];
  for (const line of text.split('\n').map(raw => raw.trim())) {
    if (line === '' || line.startsWith('#')) continue;
    const found = SAMPLE.exec(line);
    if (!found || (!NUMBER.test(found[3]) && !NO_NUMBERS.has(found[3]))) {
      throw new Error(`no sample of a metric: ${line.slice(0, 200)}`);
    }
    const [, name, labels = '', value] = found;
    samples.push({
      name,
      labels: labelsOf(labels, line.slice(0, 200)),
      value: NO_NUMBERS.has(value) ? null : Number(value),
    });
  }
  return samples;
}
