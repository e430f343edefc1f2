/** A name with what it is. */
export type Fact = [string, string];

/** Facts in columns or, if they are short, in lines one behind the other. */
export function FactList({facts, short}: {facts: Fact[], short?: boolean}) {
  return (
    <dl class={short ? 'facts short' : 'facts'}>
      {facts.map(([name, value]) => (
        <div key={name}><dt>{name}</dt><dd>{value}</dd></div>
      ))}
    </dl>
  );
}
