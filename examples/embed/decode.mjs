// Decodes `.tcgs` files with the WebAssembly module: node decode.mjs MODULE.wasm FILE...
// In a page, `WebAssembly.instantiateStreaming(fetch('tcgs_wasm.wasm'))` takes the place of the first lines.
import { readFileSync } from 'node:fs';

const [modulePath, ...files] = process.argv.slice(2);
const { instance } = await WebAssembly.instantiate(readFileSync(modulePath));
const { memory, input, decode, report, features } = instance.exports;

for (const file of files) {
  const bytes = readFileSync(file);
  const start = input(bytes.length);
  // Calls may grow the memory, which detaches older views of it.
  new Uint8Array(memory.buffer, start, bytes.length).set(bytes);
  const length = decode();
  const said = JSON.parse(new TextDecoder().decode(new Uint8Array(memory.buffer, report(), length)));
  if (said.error) throw new Error(`${file}: ${said.error}`);
  const values = new Float32Array(memory.buffer, features(), said.anchors * said.feature_dim);
  console.log(file, said, 'first features', values.slice(0, 3));
}
