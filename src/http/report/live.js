'use strict';
// Keeps the page of an unfinished job up to date: progress by its events, the picture and the curves by asking for those that changed.
(() => {
  const at = id => document.getElementById(id);
  if (!at('live') || location.protocol === 'file:') return;
  // The page's own address may hold a user's name and key, and what is derived from it then would too; the browser sends them anyway.
  const page = location.origin + location.pathname;
  const base = page.replace(/report$/, '');
  const LOOK_MS = 2000;
  const tell = text => { at('told').textContent = text; };
  const SILENT = 'The service does not answer.';

  let shown = '';
  const look = async () => {
    try {
      const answer = await fetch(`${base}preview`);
      const tag = answer.headers.get('etag');
      if (!answer.ok || tag === shown) return;
      shown = tag;
      const old = at('preview').src;
      at('preview').src = URL.createObjectURL(await answer.blob());
      if (old.startsWith('blob:')) URL.revokeObjectURL(old);
      if (!at('photograph').getAttribute('src')) at('photograph').src = `${base}preview?of=photograph`;
      at('pictures').hidden = false;
    } catch { /* The next look may find it. */ }
  };
  setInterval(() => { if (document.visibilityState === 'visible') look(); }, LOOK_MS);

  let busy = false;
  let failed = false;
  const refresh = async () => {
    if (busy || document.visibilityState !== 'visible') return;
    busy = true;
    try {
      const answer = await fetch(page, { headers: { Accept: 'text/html' } });
      // The job was deleted, or the session has ended: the service says which.
      if ([401, 403, 404].includes(answer.status)) { location.reload(); return; }
      if (answer.ok) {
        if (failed && at('told').textContent === SILENT) tell('');
        failed = false;
        const fresh = new DOMParser().parseFromString(await answer.text(), 'text/html');
        if (!fresh.getElementById('live')) { location.reload(); return; }
        for (const id of ['progress', 'curves', 'state']) at(id).replaceWith(document.adoptNode(fresh.getElementById(id)));
      }
    } catch { failed = true; tell(SILENT); }
    setTimeout(() => { busy = false; }, LOOK_MS);
  };

  // Only while the page is seen: a browser has six connections to a service, and a stream takes one.
  let source = null;
  let polling = 0;
  let seen = '';
  const follow = () => {
    source = new EventSource(`${base}events${seen && `?after=${seen}`}`);
    const changed = ({ lastEventId }) => { seen = lastEventId; refresh(); };
    for (const kind of ['state', 'phase', 'progress', 'attempt']) source.addEventListener(kind, changed);
    source.addEventListener('closed', () => location.reload());
    // A browser does not come again after a refusal, such as that of too many streams.
    source.addEventListener('error', ({ target }) => {
      if (target.readyState === EventSource.CLOSED) polling = setInterval(refresh, 5 * LOOK_MS);
    });
  };
  if (document.visibilityState === 'visible') follow();
  document.addEventListener('visibilitychange', () => {
    if (source) source.close();
    clearInterval(polling);
    if (document.visibilityState === 'visible') { follow(); refresh(); }
  });

  tell('');
  const cancel = at('cancel');
  if (!cancel) return;
  cancel.hidden = false;
  cancel.addEventListener('click', async () => {
    cancel.disabled = true;
    try {
      const answer = await fetch(`${base}cancel`, { method: 'POST' });
      if (answer.ok) { tell('The job is being cancelled.'); return; }
      tell((await answer.json().catch(() => ({}))).detail || `The service answered ${answer.status}.`);
    } catch { tell(SILENT); }
    cancel.disabled = false;
  });
})();
