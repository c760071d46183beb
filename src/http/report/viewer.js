'use strict';
// Turns the scene: one request at a time, small pictures while it moves, a full one when it rests.
(() => {
  const viewer = document.getElementById('viewer');
  if (!viewer) return;
  const picture = viewer.querySelector('img');
  const told = viewer.querySelector('figcaption');
  const chosen = document.getElementById('viewer-lambda');
  if (location.protocol === 'file:') {
    told.textContent = 'A saved page has no service behind it; open the report at the service to turn the scene.';
    return;
  }

  const vector = text => text.split(',').map(Number);
  const add = (a, b, by) => a.map((v, i) => v + by * b[i]);
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const unit = a => a.map(v => v / Math.hypot(...a));

  // The page's own address may hold a user's name and key, and what is derived from it then would too; the browser sends them anyway.
  const views = location.origin + viewer.dataset.href;
  const fov = Number(viewer.dataset.fov);
  const aspect = Number(viewer.dataset.aspect);
  const up = unit(vector(viewer.dataset.up));
  const east = unit(cross(up, Math.abs(up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0]));
  const north = cross(up, east);
  const FULL = 640;
  const STEEPEST = 1.5;
  const AIM_MS = 120;

  const first = () => {
    const center = vector(viewer.dataset.center);
    const offset = add(vector(viewer.dataset.position), center, -1);
    const distance = Math.hypot(...offset);
    const height = Math.asin(dot(offset, up) / distance);
    return { center, distance, yaw: Math.atan2(dot(offset, north), dot(offset, east)), pitch: Math.max(-STEEPEST, Math.min(STEEPEST, height)) };
  };
  let pose = first();
  const outward = () => {
    const flat = Math.cos(pose.pitch);
    return add(add(up.map(v => v * Math.sin(pose.pitch)), east, flat * Math.cos(pose.yaw)), north, flat * Math.sin(pose.yaw));
  };

  let coarse = 160;
  let moving = false;
  let wanted = null;
  let busy = false;
  let resting = 0;

  const query = width => {
    const tall = Math.max(1, Math.round(width / aspect));
    const place = add(pose.center, outward(), pose.distance);
    const fields = { position: place, look_at: pose.center, up, fov, width, height: tall, format: 'jpeg' };
    if (chosen) fields.lambda = chosen.value;
    return new URLSearchParams(Object.entries(fields).map(([name, value]) => [name, String(value)]));
  };

  const draw = async () => {
    if (busy || wanted === null) return;
    const width = wanted === 'full' ? FULL : coarse;
    wanted = null;
    busy = true;
    let pause = 0;
    try {
      const began = performance.now();
      const answer = await fetch(`${views}?${query(width)}`);
      if (answer.ok) {
        const old = picture.src;
        picture.src = URL.createObjectURL(await answer.blob());
        picture.alt = 'The scene from the chosen place';
        if (old.startsWith('blob:')) URL.revokeObjectURL(old);
        const took = performance.now() - began;
        if (width < FULL) coarse = Math.round(Math.max(96, Math.min(400, width * Math.sqrt(AIM_MS / Math.max(took, 1)))));
        told.textContent = `${width} pixels wide in ${Math.round(took)} ms`;
      } else if (answer.status === 429 || answer.status === 503) {
        pause = 1000 * Math.max(1, Number(answer.headers.get('retry-after')) || 1);
        wanted = wanted ?? (width < FULL ? 'coarse' : 'full');
        told.textContent = 'The service is busy; asking again soon.';
      } else {
        const problem = await answer.json().catch(() => ({}));
        told.textContent = problem.detail || `The service answered ${answer.status}.`;
      }
    } catch (fault) {
      told.textContent = 'The service does not answer.';
    }
    setTimeout(() => { busy = false; draw(); }, pause);
  };

  const show = () => {
    wanted = 'coarse';
    clearTimeout(resting);
    if (!moving) rest();
    draw();
  };
  const rest = () => {
    clearTimeout(resting);
    resting = setTimeout(() => { wanted = 'full'; draw(); }, 200);
  };

  const turn = (across, down) => {
    pose.yaw -= across;
    pose.pitch = Math.max(-STEEPEST, Math.min(STEEPEST, pose.pitch + down));
    show();
  };
  const shift = (across, down) => {
    const right = unit(cross(outward().map(v => -v), up));
    const above = cross(outward(), right);
    pose.center = add(add(pose.center, right, -across * pose.distance), above, down * pose.distance);
    show();
  };
  const approach = factor => {
    pose.distance *= factor;
    show();
  };

  picture.draggable = false;
  viewer.classList.add('live');
  // Pointers that are down, with where each is and where it began. One turns the scene, two move and zoom it.
  const pointers = new Map();
  const TAP = 8;
  const pair = () => {
    const [a, b] = pointers.values();
    return { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, spread: Math.max(1, Math.hypot(a.x - b.x, a.y - b.y)) };
  };
  picture.addEventListener('pointerdown', event => {
    moving = true;
    const { clientX: x, clientY: y } = event;
    pointers.set(event.pointerId, { x, y, from: [x, y] });
    picture.setPointerCapture(event.pointerId);
    event.preventDefault();
    viewer.focus();
  });
  picture.addEventListener('pointermove', event => {
    const pointer = pointers.get(event.pointerId);
    if (!pointer) return;
    const scale = 3 / picture.clientWidth;
    const before = pointers.size === 2 ? pair() : null;
    const [across, down] = [event.clientX - pointer.x, event.clientY - pointer.y];
    [pointer.x, pointer.y] = [event.clientX, event.clientY];
    if (before) {
      const after = pair();
      shift((after.x - before.x) * scale * 0.4, (after.y - before.y) * scale * 0.4);
      approach(before.spread / after.spread);
    } else if (pointers.size === 1) {
      if (event.shiftKey) shift(across * scale * 0.4, down * scale * 0.4); else turn(across * scale, down * scale);
    }
  });
  for (const end of ['pointerup', 'pointercancel']) {
    picture.addEventListener(end, event => {
      const pointer = pointers.get(event.pointerId);
      pointers.delete(event.pointerId);
      // A finger's vertical way scrolls the page until the viewer is tapped, then turns the scene until something else is touched.
      const way = pointer ? Math.hypot(event.clientX - pointer.from[0], event.clientY - pointer.from[1]) : Infinity;
      if (end === 'pointerup' && event.pointerType === 'touch' && way < TAP) viewer.classList.add('held');
      if (pointers.size === 0) { moving = false; rest(); }
    });
  }
  document.addEventListener('pointerdown', event => {
    if (!viewer.contains(event.target)) viewer.classList.remove('held');
  });
  viewer.addEventListener('wheel', event => {
    event.preventDefault();
    approach(Math.exp(0.001 * event.deltaY));
  }, { passive: false });
  const keys = {
    ArrowLeft: () => turn(-0.1, 0), ArrowRight: () => turn(0.1, 0), ArrowUp: () => turn(0, 0.1), ArrowDown: () => turn(0, -0.1),
    '+': () => approach(0.9), '-': () => approach(1 / 0.9), 0: () => { pose = first(); show(); },
  };
  viewer.addEventListener('keydown', event => {
    const action = keys[event.key];
    if (action) { event.preventDefault(); action(); }
  });
  if (chosen) chosen.addEventListener('change', show);
  wanted = 'full';
  draw();
})();
