import {savePng, saveSvg, type Sheet} from '../draw/svg.js';

/** Buttons that save the view as a file. */
export function Export({sheet, name}: {sheet: () => Sheet, name: string}) {
  return (
    <div class="export" role="group" aria-label="Save this view">
      <button type="button" onClick={() => void savePng(sheet(), name)}>
        PNG
      </button>
      <button type="button" onClick={() => void saveSvg(sheet(), name)}>
        SVG
      </button>
    </div>
  );
}
