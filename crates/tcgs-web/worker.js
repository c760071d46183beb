'use strict';
// The worker of a viewer: decodes a scene, draws it on the page's canvas and answers with pictures. It follows the module's JavaScript in
// one script. Messages in, one answered after the other:
//   { open: { module, file, canvas } }   bytes of the module and of a .tcgs file, and an OffscreenCanvas
//   { draw: camera }, { pixels: camera }, { depth: camera }   a camera as POST /v1/jobs/{id}/views takes it
// Messages out: { opened }, { drawn }, { pixels }, { depth }, and { fault } in place of any of them.
(() => {
  let viewer = null;

  const actions = {
    async open({ module, file, canvas }) {
      await wasm_bindgen({ module_or_path: await WebAssembly.compile(module) });
      const scene = wasm_bindgen.SceneFile.decode(new Uint8Array(file));
      const opened = JSON.parse(scene.summary());
      viewer = await scene.show(canvas);
      return { opened };
    },
    async draw(camera) {
      await viewer.draw(JSON.stringify(camera));
      return { drawn: true };
    },
    async pixels(camera) {
      return { pixels: await viewer.pixels(JSON.stringify(camera)) };
    },
    async depth(camera) {
      return { depth: await viewer.depth(JSON.stringify(camera)) };
    },
  };

  // Faults of the module end no promise.
  onerror = message => { postMessage({ fault: String(message) }); };
  onunhandledrejection = ({ reason }) => { postMessage({ fault: String(reason) }); };

  let last = Promise.resolve();
  onmessage = ({ data }) => {
    const [[name, value]] = Object.entries(data);
    last = last.then(() => actions[name](value)).catch(error => ({ fault: String(error.message || error) })).then(answer => postMessage(answer));
  };
})();
