// Exchanges a key for a session, and ends it.
(() => {
  const { at, ask, problem, tell, silent } = page;
  const change = async options => {
    try {
      const answer = await ask('session', options);
      if (answer.ok) location.reload(); else tell(await problem(answer));
    } catch { tell(silent); }
  };
  const form = at('sign-in');
  if (form) form.addEventListener('submit', event => {
    event.preventDefault();
    change({ method: 'POST', headers: { Authorization: `Bearer ${at('key').value.trim()}` } });
  });
  const out = at('sign-out');
  if (out) out.addEventListener('click', () => change({ method: 'DELETE' }));
})();
