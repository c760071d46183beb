// Sends a dataset by a resumable upload (tus 1.0.0), then makes a job of it. Files that are not one zip or video become a zip here, without
// compression: photographs have their own.
(() => {
  const { at, ask, problem, tell, silent, grouped, size, duration } = page;
  const drop = at('drop');
  if (!drop) return;
  drop.hidden = false;

  const CHUNK = 8 << 20;
  const MOST = 0xffffffff;
  const LONGEST_PAUSE = 30000;
  class Failure extends Error {}
  const LOST = 'A file cannot be read any more; choose the files again.';
  const sleep = (ms, signal) => new Promise((done, failed) => {
    const timer = setTimeout(done, ms);
    signal.addEventListener('abort', () => { clearTimeout(timer); failed(signal.reason); }, { once: true });
  });

  // What the browser knows of uploads that were not finished.
  const remembered = {
    get: key => { try { return localStorage.getItem(key); } catch { return null; } },
    set: (key, value) => { try { if (value) localStorage.setItem(key, value); else localStorage.removeItem(key); } catch { /* private window */ } },
  };

  const TABLE = Uint32Array.from({ length: 256 }, (_, byte) => {
    let sum = byte;
    for (let bit = 0; bit < 8; bit++) sum = sum & 1 ? 0xedb88320 ^ (sum >>> 1) : sum >>> 1;
    return sum >>> 0;
  });
  const crc32 = async (file, signal) => {
    let sum = 0xffffffff;
    const reader = file.stream().getReader();
    for (;;) {
      const { done, value } = await reader.read();
      if (done || signal.aborted) break;
      for (let i = 0; i < value.length; i++) sum = TABLE[(sum ^ value[i]) & 255] ^ (sum >>> 8);
    }
    signal.throwIfAborted();
    return (sum ^ 0xffffffff) >>> 0;
  };
  const record = (length, fields) => {
    const view = new DataView(new ArrayBuffer(length));
    for (const [offset, bytes, value] of fields) if (bytes === 2) view.setUint16(offset, value, true); else view.setUint32(offset, value, true);
    return view.buffer;
  };
  // The same files give the same bytes, so that an upload of them can go on later.
  const zip = async (entries, signal, show) => {
    const [parts, directory] = [[], []];
    let offset = 0;
    let read = 0;
    const total = entries.reduce((sum, { file }) => sum + file.size, 0);
    if (total > MOST - (1 << 24) || entries.length > 0xfffe) throw new Failure('That is more than 4 GB or 65 534 files; send it as one zip.');
    for (const { path, file } of entries) {
      const name = new TextEncoder().encode(path);
      const sum = await crc32(file, signal);
      // UTF-8 names, no compression, 1980-01-01.
      const common = at => [[at, 2, 20], [at + 2, 2, 0x800], [at + 8, 2, 0x21], [at + 10, 4, sum], [at + 14, 4, file.size], [at + 18, 4, file.size], [at + 22, 2, name.length]];
      parts.push(record(30, [[0, 4, 0x04034b50], ...common(4)]), name, file);
      directory.push(record(46, [[0, 4, 0x02014b50], [4, 2, 20], ...common(6), [42, 4, offset]]), name);
      offset += 30 + name.length + file.size;
      read += file.size;
      show(total ? read / total : 1);
    }
    const list = new Blob(directory);
    const end = record(22, [[0, 4, 0x06054b50], [8, 2, entries.length], [10, 2, entries.length], [12, 4, list.size], [16, 4, offset]]);
    return new Blob([...parts, list, end]);
  };

  const TUS = { 'Tus-Resumable': '1.0.0' };
  // How much of an upload has arrived; undefined if nobody answers, null if it is over.
  const arrived = async (place, signal) => {
    try {
      const answer = await ask(place, { method: 'HEAD', headers: TUS, signal });
      if (answer.ok) return Number(answer.headers.get('upload-offset'));
      return [404, 410].includes(answer.status) ? null : undefined;
    } catch { signal.throwIfAborted(); return undefined; }
  };
  const begin = async (blob, name, signal) => {
    const encoded = btoa(String.fromCharCode(...new TextEncoder().encode(name)));
    const headers = { ...TUS, 'Upload-Length': String(blob.size), 'Upload-Metadata': `filename ${encoded}` };
    const answer = await ask('v1/uploads', { method: 'POST', headers, signal });
    if (!answer.ok) throw new Failure(await problem(answer));
    return answer.headers.get('location');
  };
  const send = async (blob, name, key, signal, show) => {
    let place = remembered.get(key);
    let offset = place ? await arrived(place, signal) : null;
    if (typeof offset !== 'number') {
      place = await begin(blob, name, signal);
      remembered.set(key, place);
      offset = 0;
    }
    let pause = 1000;
    while (offset < blob.size) {
      show(offset, pause > 1000);
      const chunk = blob.slice(offset, offset + CHUNK);
      try {
        const headers = { ...TUS, 'Upload-Offset': String(offset), 'Content-Type': 'application/offset+octet-stream' };
        const answer = await ask(place, { method: 'PATCH', headers, body: chunk, signal });
        if (answer.ok || answer.status === 409) {
          offset = Number(answer.headers.get('upload-offset'));
          pause = 1000;
          continue;
        }
        if (![408, 423, 429, 500, 502, 503, 504].includes(answer.status)) throw new Failure(await problem(answer));
      } catch (fault) {
        signal.throwIfAborted();
        if (fault instanceof Failure) throw fault;
        // A request whose file has changed or is gone fails as one without an answer does.
        await chunk.arrayBuffer();
      }
      signal.throwIfAborted();
      await sleep(pause, signal);
      pause = Math.min(2 * pause, LONGEST_PAUSE);
      const known = await arrived(place, signal);
      if (known === null) { remembered.set(key, null); throw new Failure('The upload has expired; send it again.'); }
      if (known !== undefined) offset = known;
    }
    show(offset, false);
    return place.split('/').pop();
  };

  const post = async (path, body, more = {}) => {
    const answer = await ask(path, { method: 'POST', headers: { 'Content-Type': 'application/json', ...more }, body: JSON.stringify(body) });
    if (!answer.ok) throw new Failure(await problem(answer));
    return answer.json();
  };

  // Which part of the panel shows.
  const show = part => { for (const id of ['drop', 'sending', 'train']) at(id).hidden = id !== part; };
  const trouble = text => { at('trouble').textContent = text; at('trouble').hidden = !text; };
  const message = fault => {
    if (['NotReadableError', 'NotFoundError'].includes(fault.name)) return LOST;
    return fault instanceof Failure ? fault.message : silent;
  };
  const fail = fault => { show('drop'); if (fault.name !== 'AbortError') trouble(message(fault)); };

  let dataset = null;
  // How its files are read: the same for its check, its estimates and its job.
  let reading = {};
  let attempt = '';
  let stop = new AbortController();

  const isHidden = path => path.split('/').some(part => part.startsWith('.') || part === '__MACOSX' || part === 'Thumbs.db');
  const take = async entries => {
    entries = entries.filter(({ path }) => !isHidden(path)).sort((a, b) => (a.path < b.path ? -1 : 1));
    if (entries.length === 0) { trouble('There are no files in that.'); return; }
    trouble('');
    tell('');
    show('sending');
    stop = new AbortController();
    const { signal } = stop;
    const bar = at('sending-progress');
    const one = entries.length === 1 && /\.(zip|mp4|mov)$/i.test(entries[0].path) ? entries[0] : null;
    const top = entries[0].path.split('/')[0];
    const name = one ? one.path : entries[0].path.includes('/') ? `${top}.zip` : `${entries.length} photographs.zip`;
    at('sending-name').textContent = one ? one.path : `${grouped(entries.length)} files`;
    const say = (text, done) => { at('sending-text').textContent = text; bar.value = done; };
    try {
      const blob = one ? one.file : await zip(entries, signal, done => say('Reading the files', done));
      const marks = entries.map(({ path, file }) => `${path} ${file.size} ${file.lastModified}`).join('\n');
      const key = `tcgs upload ${page.base} ${await crc32(new Blob([marks]), signal)} ${blob.size}`;
      const upload = await send(blob, name, key, signal, (offset, waits) => {
        say(`${size(offset)} of ${size(blob.size)}${waits ? '; the service does not answer, trying again' : ''}`, offset / blob.size);
      });
      at('stop').hidden = true;
      say('The service checks the dataset', 1);
      reading = at('unmasked').checked ? { masks: 'none' } : {};
      dataset = await post('v1/datasets', { upload_id: upload, ...reading });
      remembered.set(key, null);
      await offer(name.replace(/\.\w+$/, ''));
    } catch (fault) { fail(fault); }
    at('stop').hidden = false;
  };

  const span = (range, unit) => (unit(range.low) === unit(range.high) ? unit(range.low) : `${unit(range.low)} to ${unit(range.high)}`);
  const offer = async name => {
    const { train, test } = dataset.summary;
    at('dataset-text').textContent = test ? `${grouped(train)} photographs to train on, ${grouped(test)} held out.` : `${grouped(train)} photographs.`;
    at('name').value = name.slice(0, 100);
    attempt = `${Date.now()}-${Math.random()}`;
    const outputs = [...at('train').querySelectorAll('[data-preset]')];
    for (const output of outputs) output.textContent = '';
    show('train');
    at('train').querySelector('button').focus();
    for (const output of outputs) {
      try {
        const estimate = await post('v1/estimate', { dataset_id: dataset.id, preset: output.dataset.preset, ...reading });
        const time = estimate.seconds ? span(estimate.seconds, duration) : 'a time not known yet';
        output.textContent = `${grouped(estimate.steps)} steps, ${time}, ${span(estimate.file_bytes, size)}`;
      } catch (fault) { output.textContent = fault instanceof Failure ? fault.message : silent; }
    }
  };

  at('train').addEventListener('submit', async event => {
    event.preventDefault();
    const preset = at('train').querySelector('[name=preset]:checked').value;
    const name = at('name').value.trim();
    try {
      const key = `${attempt} ${preset} ${await crc32(new Blob([name]), new AbortController().signal)}`;
      await post('v1/jobs', { dataset_id: dataset.id, preset, ...reading, ...(name && { name }) }, { 'Idempotency-Key': key });
      trouble('');
      show('drop');
      page.refresh();
    } catch (fault) { trouble(fault instanceof Failure ? fault.message : silent); }
  });
  at('put-aside').addEventListener('click', () => { trouble(''); show('drop'); });
  at('stop').addEventListener('click', () => { stop.abort(); tell('Stopped. Choose the same files again to go on from there.'); });

  const chosen = input => [...input.files].map(file => ({ path: file.webkitRelativePath || file.name, file }));
  for (const [button, input] of [['pick-files', 'files'], ['pick-folder', 'folder']]) {
    at(button).addEventListener('click', () => at(input).click());
    at(input).addEventListener('change', () => { const entries = chosen(at(input)); at(input).value = ''; if (entries.length) take(entries); });
  }

  const walk = async entry => {
    const path = entry.fullPath.replace(/^\//, '');
    if (entry.isFile) return [{ path, file: await new Promise((done, failed) => entry.file(done, failed)) }];
    const reader = entry.createReader();
    const found = [];
    for (;;) {
      const some = await new Promise((done, failed) => reader.readEntries(done, failed));
      if (some.length === 0) return found;
      for (const child of some) found.push(...await walk(child));
    }
  };
  const isFree = () => !drop.hidden;
  for (const kind of ['dragenter', 'dragover']) document.addEventListener(kind, event => {
    if (isFree() && event.dataTransfer.types.includes('Files')) { event.preventDefault(); drop.classList.add('over'); }
  });
  document.addEventListener('dragleave', event => { if (!event.relatedTarget) drop.classList.remove('over'); });
  document.addEventListener('drop', async event => {
    drop.classList.remove('over');
    if (!isFree() || !event.dataTransfer.types.includes('Files')) return;
    event.preventDefault();
    const dropped = [...event.dataTransfer.items].map(item => item.webkitGetAsEntry && item.webkitGetAsEntry()).filter(Boolean);
    try {
      const entries = (await Promise.all(dropped.map(walk))).flat();
      take(entries);
    } catch { trouble('The files cannot be read.'); }
  });
})();
