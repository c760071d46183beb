
// Makes a link to the page for those without a key.
(() => {
  const button = document.getElementById('share');
  if (!button || location.protocol === 'file:') return;
  const page = location.origin + location.pathname;
  const told = document.getElementById('shared');
  button.hidden = false;
  button.addEventListener('click', async () => {
    button.disabled = true;
    try {
      const answer = await fetch(page.replace(/report$/, 'shares'), { method: 'POST' });
      const share = await answer.json().catch(() => ({}));
      if (answer.ok) {
        const link = document.createElement('a');
        link.href = link.textContent = page.replace(/\/v1\/jobs\/[^/]*\/report$/, share.url);
        told.replaceChildren('Whoever has this link sees this page until ', share.expires_at.slice(0, 10), ': ', link);
      } else told.textContent = share.detail || `The service answered ${answer.status}.`;
    } catch { told.textContent = 'The service does not answer.'; }
    button.disabled = false;
  });
})();
