import {readdirSync, readFileSync, writeFileSync} from 'node:fs';
import {join} from 'node:path';
import {brotliCompressSync, gzipSync} from 'node:zlib';

import {defineConfig, type Plugin} from 'vite';

const COMPRESSED = /\.(css|html|js|svg)$/;
const LICENCE = /^(licen[cs]e|notice)/i;

/** Leaves the files compressed beside themselves, as small as they get, for the
 * server to send. */
function compressed(): Plugin {
  return {
    name: 'compressed',
    writeBundle({dir}, bundle) {
      for (const name of Object.keys(bundle)) {
        if (!COMPRESSED.test(name)) continue;
        const path = join(dir!, name);
        const content = readFileSync(path);
        writeFileSync(`${path}.gz`, gzipSync(content, {level: 9}));
        writeFileSync(`${path}.br`, brotliCompressSync(content));
      }
    },
  };
}

/** Leaves the licences of all packages that code was taken from, as most of them
 * ask for. */
function licences(): Plugin {
  return {
    name: 'licences',
    generateBundle() {
      const folders = new Set(Array.from(this.getModuleIds(), id =>
          /^\0?(.*\/node_modules\/(?:@[^/]+\/)?[^/]+)\//.exec(id)?.[1])
                                  .filter(folder => folder !== undefined));
      const source = [...folders].sort().map(folder => {
        const {name, version, license} = JSON.parse(
            readFileSync(join(folder, 'package.json'), 'utf8'));
        const texts = readdirSync(folder).filter(file => LICENCE.test(file))
            .map(file => readFileSync(join(folder, file), 'utf8'));
        return [`${name} ${version}: ${license}`, ...texts].join('\n\n');
      }).join(`\n${'-'.repeat(80)}\n`);
      this.emitFile({type: 'asset', name: 'notices.txt', source});
    },
  };
}

/** Has Node.js take the program for a module wherever it is copied to. */
function asModule(): Plugin {
  return {
    name: 'as-module',
    generateBundle() {
      this.emitFile({type: 'asset', fileName: 'package.json',
                     source: '{"type": "module"}\n'});
    },
  };
}

// The page goes to dist/web. Nothing is inlined into it, since the server's
// Content-Security-Policy lets no inline script or style in. The server goes to
// dist/server, with all packages that it uses, so that dist needs nothing else.
export default defineConfig(({isSsrBuild}) => ({
  root: isSsrBuild ? '.' : 'web',
  esbuild: {jsx: 'automatic', jsxImportSource: 'preact'},
  plugins: isSsrBuild ? [licences(), asModule()] : [licences(), compressed()],
  ssr: {noExternal: true},
  build: {
    outDir: isSsrBuild ? 'dist/server' : '../dist/web',
    emptyOutDir: true,
    assetsInlineLimit: 0,
    modulePreload: {polyfill: false},
    target: isSsrBuild ? 'node18' : 'es2022',
    chunkSizeWarningLimit: 1500,
  },
  worker: {format: 'es', plugins: () => [licences()]},
}));
