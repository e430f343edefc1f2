import {defineConfig} from 'vite';

// The page goes to dist/web. Nothing is inlined into it, since the server's
// Content-Security-Policy lets no inline script or style in.
export default defineConfig(({isSsrBuild}) => ({
  root: isSsrBuild ? '.' : 'web',
  esbuild: {jsx: 'automatic', jsxImportSource: 'preact'},
  build: {
    outDir: isSsrBuild ? 'dist/server' : '../dist/web',
    emptyOutDir: true,
    assetsInlineLimit: 0,
    modulePreload: {polyfill: false},
    target: isSsrBuild ? 'node18' : 'es2022',
    chunkSizeWarningLimit: 1500,
  },
  worker: {format: 'es'},
}));
