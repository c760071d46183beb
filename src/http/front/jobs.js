// Follows the jobs of the list and acts on them.
(() => {
  const { base, at, ask, problem, tell, silent, grouped, size, duration } = page;
  const list = at('jobs');
  if (!list) return;
  const row = id => list.querySelector(`[data-job="${id}"]`);

  // Jobs without a card: those that the next page may have, and those that are of another page.
  const missed = new Set();
  const elsewhere = new Set();

  // The page itself, asked for again, has the cards that changed.
  let busy = false;
  let again = false;
  let failed = false;
  const refresh = async () => {
    if (busy) { again = true; return; }
    busy = true;
    const sought = [...missed];
    missed.clear();
    try {
      const answer = await fetch(location.origin + location.pathname + location.search, { headers: { Accept: 'text/html' } });
      if (answer.ok) {
        if (failed && at('told').textContent === silent) tell('');
        failed = false;
        merge(new DOMParser().parseFromString(await answer.text(), 'text/html'));
        for (const id of sought) if (!row(id)) elsewhere.add(id);
      }
    } catch { failed = true; tell(silent); }
    setTimeout(() => { busy = false; if (again) { again = false; refresh(); } }, 500);
  };
  const merge = fresh => {
    const next = fresh.getElementById('jobs');
    if (!next) { location.reload(); return; }
    const kept = new Map([...list.children].map(card => [card.dataset.job, card]));
    const cards = [...next.children].map(card => {
      const old = kept.get(card.dataset.job);
      return old && old.outerHTML === card.outerHTML ? old : document.adoptNode(card);
    });
    const focused = list.contains(document.activeElement) ? document.activeElement : null;
    const [job, act] = focused ? [focused.closest('[data-job]').dataset.job, focused.dataset.act] : [];
    list.replaceChildren(...cards);
    at('none').hidden = cards.length > 0;
    const card = job && row(job);
    if (card) (card.querySelector(`[data-act="${act}"]`) || card.querySelector('.name')).focus();
  };

  const figures = ({ phase, progress }) => [
    phase,
    progress.step > 0 && `${grouped(progress.step)} of ${grouped(progress.total)}`,
    progress.psnr !== null && `${progress.psnr.toFixed(1)} dB`,
    progress.bytes !== null && `about ${size(progress.bytes)}`,
    progress.eta_seconds !== null && `${duration(progress.eta_seconds)} left`,
  ].filter(Boolean).join(', ');

  // The picture of a job in training, if it has changed.
  const looking = new Set();
  const look = async card => {
    const id = card.dataset.job;
    if (looking.has(id) || document.visibilityState !== 'visible') return;
    looking.add(id);
    try {
      const answer = await ask(`v1/jobs/${id}/preview`);
      const tag = answer.headers.get('etag');
      if (answer.ok && card.isConnected && tag !== card.dataset.tag) {
        const picture = document.createElement('img');
        picture.alt = '';
        picture.src = URL.createObjectURL(await answer.blob());
        await picture.decode();
        URL.revokeObjectURL(picture.src);
        card.dataset.tag = tag;
        card.querySelector('.thumb').replaceChildren(picture);
      }
    } catch { /* The next look may find it. */ }
    setTimeout(() => looking.delete(id), 1000);
  };

  const show = job => {
    const card = row(job.id);
    const bar = card && card.querySelector('progress');
    if (card && card.dataset.state === 'running' && job.state === 'running' && bar && !job.cancel_requested) {
      bar.max = Math.max(1, job.progress.total);
      bar.value = job.progress.step;
      card.querySelector('.figures').textContent = figures(job);
      look(card);
    } else if (card || ('first' in list.dataset && !elsewhere.has(job.id))) {
      if (!card) missed.add(job.id);
      refresh();
    }
  };
  // Only while the page is seen: a browser has six connections to a service, and a stream takes one.
  let source = null;
  let polling = 0;
  let isLate = document.visibilityState !== 'visible';
  const follow = () => {
    source = new EventSource(`${base}v1/jobs`);
    source.addEventListener('open', () => { if (isLate) refresh(); isLate = true; });
    source.addEventListener('job', event => show(JSON.parse(event.data)));
    source.addEventListener('gone', refresh);
    source.addEventListener('closed', () => location.reload());
    // A browser does not come again after a refusal, such as that of too many streams.
    source.addEventListener('error', ({ target }) => {
      if (target.readyState !== EventSource.CLOSED) return;
      if (isLate) refresh();
      polling = setInterval(refresh, 10000);
    });
  };
  if (document.visibilityState === 'visible') follow();
  document.addEventListener('visibilitychange', () => {
    if (source) source.close();
    clearInterval(polling);
    isLate = true;
    if (document.visibilityState === 'visible') follow();
  });

  list.addEventListener('click', async event => {
    const button = event.target.closest('[data-act]');
    if (!button) return;
    const { job, name } = button.closest('[data-job]').dataset;
    const act = button.dataset.act;
    if (act === 'delete' && !confirm(`Delete ${name} and its files?`)) return;
    button.disabled = true;
    try {
      const answer = act === 'delete' ? await ask(`v1/jobs/${job}`, { method: 'DELETE' }) : await ask(`v1/jobs/${job}/${act}`, { method: 'POST' });
      tell(answer.ok ? '' : await problem(answer));
    } catch { tell(silent); }
    button.disabled = false;
    refresh();
  });
  page.refresh = refresh;
})();
