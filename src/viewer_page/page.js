'use strict';
// Shows a scene: a worker decodes the file and draws it by WebGPU. Where that cannot be, the service draws, one picture at a time.
(() => {
  const scene = JSON.parse(document.getElementById('scene').textContent);
  const byId = id => document.getElementById(id);
  const stage = byId('stage');
  const canvas = byId('canvas');
  const picture = byId('picture');
  const overlay = byId('overlay');
  const photograph = byId('photograph');
  const wipe = byId('wipe');
  const line = byId('line');
  const loading = byId('loading');
  const stops = byId('stops');
  const say = text => { line.textContent = text; };
  // The page's own address may hold a user's name and key, which no request may; the browser sends them anyway.
  const at = address => new URL(address, new URL(location.pathname, location.origin));

  const add = (a, b, by = 1) => a.map((v, i) => v + by * b[i]);
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const length = a => Math.hypot(...a);
  const unit = a => a.map(v => v / length(a));
  const clamp = (value, low, high) => Math.min(high, Math.max(low, value));
  const turned = (a, axis, angle) => {
    const [cos, sin] = [Math.cos(angle), Math.sin(angle)];
    return add(add(a.map(v => v * cos), cross(axis, a), sin), axis, dot(axis, a) * (1 - cos));
  };

  // The pose: where the camera is, its axes in the world, and how far ahead the point lies that it turns about.
  const up = unit(scene.up);
  const column = (rows, i) => rows.slice(0, 3).map(row => row[i]);
  const reach = Math.max(...scene.stops.map(({ camera_to_world: rows }) => length(add(column(rows, 3), scene.center, -1))), 1e-6);
  const MIN_DISTANCE = 0.02 * reach;
  const MAX_DISTANCE = 3 * reach;
  const LEAST_UPRIGHT = 0.1;
  let pose = null;
  let lens = null;
  let stop = 0;

  const go = index => {
    stop = (index + scene.stops.length) % scene.stops.length;
    const { camera_to_world: rows, fx, fy, cx, cy, width, height } = scene.stops[stop];
    const [right, down, ahead, position] = [0, 1, 2, 3].map(i => column(rows, i));
    const depth = dot(add(scene.center, position, -1), ahead);
    // Cameras that look outwards have the center behind them.
    const distance = depth > MIN_DISTANCE ? Math.min(depth, MAX_DISTANCE) : reach;
    pose = { right, down, ahead, position, distance };
    lens = { fx, fy, cx, cy, width, height };
    stops.value = String(stop);
    show(true);
  };
  const pivot = () => add(pose.position, pose.ahead, pose.distance);
  const rotate = (axis, angle) => {
    for (const name of ['right', 'down', 'ahead']) pose[name] = unit(turned(pose[name], axis, angle));
  };
  // 1 for a level camera, 0 for one that looks straight up or down, less for one on its head.
  const upright = down => -dot(down, up);
  const turn = (across, along) => {
    const held = flying ? pose.position : pivot();
    const sign = flying ? -1 : 1;
    rotate(up, -sign * across);
    const angle = -sign * along;
    const next = upright(turned(pose.down, pose.right, angle));
    if (next > LEAST_UPRIGHT || next >= upright(pose.down) - 1e-9) rotate(pose.right, angle);
    pose.position = flying ? held : add(held, pose.ahead, -pose.distance);
    show();
  };
  const move = step => {
    const offset = add(add(pose.position, step), scene.center, -1);
    const far = length(offset);
    pose.position = add(scene.center, offset, Math.min(1, (MAX_DISTANCE + reach) / far));
    show();
  };
  const shift = (across, along) => move(add(pose.right.map(v => -v * across * pose.distance), pose.down, -along * pose.distance));
  const approach = factor => {
    const held = pivot();
    pose.distance = clamp(pose.distance * factor, MIN_DISTANCE, MAX_DISTANCE);
    pose.position = add(held, pose.ahead, -pose.distance);
    show();
  };

  // The camera for a picture of this size: the stop's own picture lies in its middle, whole.
  const camera = (width, height) => {
    const scale = Math.min(width / lens.width, height / lens.height);
    const { right, down, ahead, position } = pose;
    const row = i => [right[i], down[i], ahead[i], position[i]];
    return {
      camera_to_world: [row(0), row(1), row(2), [0, 0, 0, 1]],
      fx: lens.fx * scale, fy: lens.fy * scale,
      cx: width / 2 + (lens.cx - lens.width / 2) * scale, cy: height / 2 + (lens.cy - lens.height / 2) * scale,
      width, height,
    };
  };
  const MOST_PIXELS = 3840 * 2160;
  const size = scale => {
    const [across, along] = [stage.clientWidth, stage.clientHeight].map(v => Math.max(1, v * (devicePixelRatio || 1)));
    const fitting = Math.min(scale, Math.sqrt(MOST_PIXELS / (across * along)));
    return [across, along].map(v => Math.max(1, Math.round(v * fitting)));
  };

  // Drawing: while the scene moves, as large as is quick; at rest in full.
  const REST_MS = 150;
  let aim = 40;
  let least = 0.1;
  let draw = null;
  let busy = false;
  let wanted = null;
  let resting = 0;
  let coarse = 1;
  let whole = 0;
  let fixed = 0;
  let frames = 0;
  let atStop = false;
  let deep = false;
  let flying = false;

  const show = (exact = false) => {
    atStop = exact;
    stage.dataset.picture = 'coarse';
    const has = exact && Boolean(scene.stops[stop].photograph);
    wipe.hidden = photograph.hidden = !has;
    if (has) { photograph.src = `data:image/jpeg;base64,${scene.stops[stop].photograph}`; place(); }
    wanted = 'coarse';
    clearTimeout(resting);
    resting = setTimeout(() => { wanted = 'full'; pump(); }, REST_MS);
    pump();
  };
  // A picture takes a time that no size changes, and a time for its pixels. Fewer pixels make up for the latter alone, so the former,
  // which is known from pictures of two sizes, is at most as long again. It is forgotten slowly, or one late picture would count for good.
  const pace = (scale, ms) => {
    const pixels = scale * scale;
    if (pixels > 0.8) {
      whole = ms;
      fixed = Math.min(0.9 * fixed, ms);
    } else fixed = clamp((ms - whole * pixels) / (1 - pixels), 0, ms);
    const variable = Math.max(ms - fixed, 1e-3) / pixels;
    coarse = clamp(Math.sqrt(Math.max(aim - fixed, fixed) / variable), least, 1);
  };
  const pump = async () => {
    if (busy || !wanted || !draw) return;
    const kind = wanted;
    const full = kind === 'full';
    const scale = full ? 1 : coarse;
    wanted = null;
    busy = true;
    try {
      const ms = await draw(...size(scale), full);
      if (ms === null) wanted = wanted || kind;
      else {
        frames += 1;
        stage.dataset.frames = frames;
        if (full && !wanted) stage.dataset.picture = 'full';
        pace(scale, ms);
      }
    } catch (fault) {
      fail(fault);
    }
    busy = false;
    requestAnimationFrame(pump);
  };
  const sentence = fault => `${fault.message}.`.replace(/\.\.$/, '.');
  // Faults of the device and of the module stay. One view may need too much memory where others do not.
  const fail = fault => {
    if (!worker || (frames && fault.message.startsWith("buffer '"))) { say(fault.message); return; }
    byService(sentence(fault));
    show(atStop);
  };

  // The photograph lies over the stop's picture, up to the slider.
  const place = () => {
    const scale = Math.min(stage.clientWidth / lens.width, stage.clientHeight / lens.height);
    const [width, height] = [lens.width * scale, lens.height * scale];
    const left = (stage.clientWidth - width) / 2;
    for (const part of [photograph, wipe]) {
      part.style.width = `${width}px`;
      part.style.left = `${left}px`;
      part.style.top = `${(stage.clientHeight - height) / 2}px`;
    }
    photograph.style.height = wipe.style.height = `${height}px`;
    photograph.style.clipPath = `inset(0 ${100 - wipe.value}% 0 0)`;
  };
  wipe.addEventListener('input', place);

  // By WebGPU, in a worker.
  const waiting = [];
  let worker = null;
  const ask = (message, transfer = []) => new Promise((done, failed) => {
    waiting.push({ done, failed });
    worker.postMessage(message, transfer);
  });
  const start = address => {
    worker = new Worker(address);
    worker.onmessage = ({ data }) => {
      const { done, failed } = waiting.shift() || {};
      if (data.fault && failed) failed(new Error(data.fault)); else if (done) done(data);
    };
    worker.onerror = event => { while (waiting.length) waiting.shift().failed(new Error(event.message || 'the worker did not start')); };
  };
  const paint = (depths, width, height) => {
    let [near, far] = [Infinity, 0];
    for (const depth of depths) if (depth > 0) { near = Math.min(near, depth); far = Math.max(far, depth); }
    const image = new ImageData(width, height);
    depths.forEach((depth, i) => {
      const shade = depth > 0 ? 255 - Math.round(220 * (depth - near) / Math.max(far - near, 1e-9)) : 0;
      image.data.set([shade, shade, shade, 255], 4 * i);
    });
    [overlay.width, overlay.height] = [width, height];
    overlay.getContext('2d').putImageData(image, 0, 0);
    return [near, far];
  };
  const millions = new Intl.NumberFormat('en');
  const byWebGpu = async opened => {
    const about = `${millions.format(opened.gaussians)} Gaussians`;
    draw = async (width, height, full) => {
      const began = performance.now();
      if (deep) {
        const { depth } = await ask({ depth: camera(width, height) });
        const [near, far] = paint(depth, width, height);
        say(`${about} · depths ${near.toPrecision(3)} to ${far.toPrecision(3)}`);
      } else {
        await ask({ draw: camera(width, height) });
        if (full) say(`${about} · ${width}×${height} in ${Math.round(performance.now() - began)} ms`);
      }
      overlay.hidden = !deep;
      return performance.now() - began;
    };
    stage.dataset.mode = 'webgpu';
    stage.dataset.digest = opened.decode_sha256;
    byId('depth').hidden = false;
  };

  // By the service.
  let shown = null;
  const byService = why => {
    if (worker) worker.terminate();
    worker = null;
    while (waiting.length) waiting.shift().failed(new Error(why));
    draw = null;
    deep = false;
    canvas.hidden = overlay.hidden = byId('depth').hidden = true;
    stage.dataset.mode = 'service';
    if (!scene.view) { say(`${why} This page has no service that could draw the scene.`); return; }
    say(`${why} The service draws the first picture.`);
    // Most of the time is the network's and the queue's.
    [aim, least, coarse, whole, fixed] = [250, 0.4, 1, 0, 0];
    draw = async (width, height) => {
      const fits = Math.min(1, 1280 / Math.max(width, height));
      const [w, h] = [width, height].map(v => Math.max(1, Math.round(v * fits)));
      const began = performance.now();
      const { fx } = camera(w, h);
      // A query has no principal point and one focal length. Beside a photograph the picture is that of its frame, which has all.
      const { name, photograph: beside } = scene.stops[stop];
      const framed = atStop && Boolean(beside);
      const asked = framed ? { frame: name, width: Math.max(1, Math.round(lens.width * fx / lens.fx)) } : {
        position: pose.position, look_at: add(pose.position, pose.ahead, pose.distance), up: pose.down.map(v => -v),
        fov: 2 * Math.atan(w / (2 * fx)) * 180 / Math.PI, width: w, height: h,
      };
      const query = new URLSearchParams({ ...asked, format: 'jpeg' });
      const answer = await fetch(at(`${scene.view}${scene.view.includes('?') ? '&' : '?'}${query}`));
      if (answer.status === 429 || answer.status === 503) {
        await new Promise(done => setTimeout(done, 1000 * (Number(answer.headers.get('retry-after')) || 1)));
        return null;
      }
      if (!answer.ok) throw new Error((await answer.json().catch(() => ({}))).detail || `The service answered ${answer.status}.`);
      const old = picture.src;
      shown = await answer.blob();
      picture.src = URL.createObjectURL(shown);
      picture.hidden = false;
      for (const side of ['left', 'top', 'width', 'height']) picture.style[side] = framed ? photograph.style[side] : '';
      if (old.startsWith('blob:')) URL.revokeObjectURL(old);
      const well = `${why} The service draws the pictures.`;
      if (line.textContent !== well) say(well);
      return performance.now() - began;
    };
  };

  // Bytes from the page itself or from its service, with progress.
  const inline = async id => {
    const text = byId(id).textContent.trim();
    const bytes = Uint8Array.from(atob(text), character => character.charCodeAt(0));
    if (!byId(id).dataset.gzip) return bytes.buffer;
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream('gzip'))).arrayBuffer();
  };
  const fetched = async (address, size) => {
    const answer = await fetch(at(address));
    if (!answer.ok) throw new Error((await answer.json().catch(() => ({}))).detail || `The service answered ${answer.status}.`);
    const parts = [];
    let got = 0;
    const reader = answer.body.getReader();
    for (let part = await reader.read(); !part.done; part = await reader.read()) {
      parts.push(part.value);
      got += part.value.length;
      if (size) { loading.value = got / size; say(`Loading ${Math.round(got / 1000)} of ${Math.round(size / 1000)} kB`); }
    }
    return new Blob(parts).arrayBuffer();
  };
  const open = async () => {
    say('Opening');
    const inside = Boolean(byId('file'));
    if (!inside && !scene.file) return byService(scene.why);
    if (!navigator.gpu || !canvas.transferControlToOffscreen) {
      // Browsers hide WebGPU from pages over http, unless they come from the same machine.
      return byService(isSecureContext ? 'This browser has no WebGPU.' : 'WebGPU needs this page over https.');
    }
    const adapter = await navigator.gpu.requestAdapter();
    if (!adapter) return byService('WebGPU has no adapter here.');
    // A browser's software adapter takes seconds for a picture. The address of a test ends in #webgpu.
    if (scene.view && (adapter.info || {}).isFallbackAdapter && location.hash !== '#webgpu') return byService('WebGPU has no GPU here.');
    const [module, file] = await Promise.all(inside
      ? [inline('module'), inline('file')]
      : [fetched(scene.module), fetched(scene.file.href, scene.file.bytes)]);
    say('Decoding');
    loading.removeAttribute('value');
    start(inside ? URL.createObjectURL(new Blob([byId('worker').textContent], { type: 'text/javascript' })) : at(scene.worker));
    const surface = canvas.transferControlToOffscreen();
    const { opened } = await ask({ open: { module, file, canvas: surface } }, [module, file, surface]);
    return byWebGpu(opened);
  };

  // Hands.
  const pointers = new Map();
  const pair = () => {
    const [a, b] = pointers.values();
    return { x: (a[0] + b[0]) / 2, y: (a[1] + b[1]) / 2, spread: Math.max(1, Math.hypot(a[0] - b[0], a[1] - b[1])) };
  };
  stage.addEventListener('pointerdown', event => {
    if (event.target === wipe) return;
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    stage.setPointerCapture(event.pointerId);
    stage.focus();
  });
  stage.addEventListener('pointermove', event => {
    const from = pointers.get(event.pointerId);
    if (!from) return;
    const scale = 3 / Math.max(stage.clientWidth, 1);
    const before = pointers.size === 2 ? pair() : null;
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    const [across, along] = [(event.clientX - from[0]) * scale, (event.clientY - from[1]) * scale];
    if (before) {
      const after = pair();
      shift((after.x - before.x) * scale * 0.4, (after.y - before.y) * scale * 0.4);
      approach(before.spread / after.spread);
    } else if (pointers.size === 1) {
      if (event.shiftKey || (event.buttons & 6)) shift(across * 0.4, along * 0.4); else turn(across, along);
    }
  });
  for (const end of ['pointerup', 'pointercancel']) stage.addEventListener(end, event => pointers.delete(event.pointerId));
  stage.addEventListener('contextmenu', event => event.preventDefault());
  stage.addEventListener('wheel', event => { event.preventDefault(); approach(Math.exp(0.001 * event.deltaY)); }, { passive: false });

  // Keys: those that fly are held down.
  const held = new Set();
  const FLIGHT = { KeyW: ['ahead', 1], KeyS: ['ahead', -1], KeyD: ['right', 1], KeyA: ['right', -1], KeyE: ['down', -1], KeyQ: ['down', 1] };
  let last = 0;
  const fly = now => {
    if (!held.size) { last = 0; return; }
    const step = last ? Math.min(0.1, (now - last) / 1000) * 0.5 * reach : 0;
    last = now;
    for (const code of held) move(pose[FLIGHT[code][0]].map(v => v * FLIGHT[code][1] * step));
    requestAnimationFrame(fly);
  };
  const keys = {
    ArrowLeft: () => turn(-0.1, 0), ArrowRight: () => turn(0.1, 0), ArrowUp: () => turn(0, 0.1), ArrowDown: () => turn(0, -0.1),
    '+': () => approach(0.9), '-': () => approach(1 / 0.9), 0: () => go(stop), ',': () => go(stop - 1), '.': () => go(stop + 1),
  };
  stage.addEventListener('keydown', event => {
    // The photograph's slider has keys of its own.
    if (event.target !== stage) return;
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (FLIGHT[event.code]) {
      if (!held.size) requestAnimationFrame(fly);
      held.add(event.code);
    } else if (keys[event.key]) keys[event.key](); else return;
    event.preventDefault();
  });
  stage.addEventListener('keyup', event => held.delete(event.code));
  stage.addEventListener('blur', () => held.clear());

  // Buttons.
  const toggle = (id, change) => byId(id).addEventListener('click', event => {
    const on = event.currentTarget.getAttribute('aria-pressed') !== 'true';
    event.currentTarget.setAttribute('aria-pressed', String(on));
    change(on);
  });
  toggle('fly', on => { flying = on; });
  toggle('depth', on => { deep = on; show(atStop); });
  byId('previous').addEventListener('click', () => go(stop - 1));
  byId('next').addEventListener('click', () => go(stop + 1));
  byId('again').addEventListener('click', () => go(stop));
  byId('full').addEventListener('click', () => (document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen()));
  stops.addEventListener('change', () => go(Number(stops.value)));
  const save = async () => {
    const [width, height] = size(1);
    let blob;
    if (worker) {
      const { pixels } = await ask({ pixels: camera(width, height) });
      const image = new ImageData(width, height);
      for (let i = 0; i < width * height; i += 1) image.data.set([pixels[3 * i], pixels[3 * i + 1], pixels[3 * i + 2], 255], 4 * i);
      const sheet = new OffscreenCanvas(width, height);
      sheet.getContext('2d').putImageData(image, 0, 0);
      blob = await sheet.convertToBlob({ type: 'image/png' });
    } else blob = shown;
    if (!blob) return;
    const link = document.createElement('a');
    link.href = URL.createObjectURL(blob);
    link.download = `${scene.title.replace(/[^\w.-]+/g, '-')}.${worker ? 'png' : 'jpg'}`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  };
  byId('shot').addEventListener('click', () => save().catch(fail));
  new ResizeObserver(() => { if (pose) show(atStop); }).observe(stage);

  scene.stops.forEach(({ name }, index) => stops.append(new Option(name, String(index))));
  go(0);
  open().catch(fault => (scene.view ? byService(sentence(fault)) : say(fault.message))).finally(() => {
    loading.hidden = true;
    if (draw) show(atStop);
  });
})();
