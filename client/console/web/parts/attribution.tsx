import type {ComponentChildren} from 'preact';

/** A text that may hold HTML, of which its links are kept and nothing else. */
export function Attribution({html}: {html: string}) {
  const parsed = new DOMParser().parseFromString(html, 'text/html');
  const render = (node: Node): ComponentChildren => {
    if (node instanceof HTMLAnchorElement &&
        /^https?:$/.test(node.protocol)) {
      return <a href={node.href} rel="noopener noreferrer" target="_blank">
        {node.textContent}</a>;
    }
    return node.hasChildNodes() ? [...node.childNodes].map(render) :
                                  node.nodeValue;
  };
  return <>{render(parsed.body)}</>;
}

/** The same without links. */
export function attributionText(html: string): string {
  return new DOMParser().parseFromString(html, 'text/html')
      .body.textContent ?? '';
}
