'use strict';
// What the parts of the page's script share.
const page = (() => {
  // The page's own address may hold a user's name and key, and what is derived from it then would too; the browser sends them anyway.
  const base = location.origin + location.pathname.replace(/[^/]*$/, '');
  const at = id => document.getElementById(id);
  const ask = (path, options) => fetch(base + path.replace(/^\//, ''), options);
  const problem = async answer => (await answer.json().catch(() => ({}))).detail || `The service answered ${answer.status}.`;
  const tell = text => { const told = at('told'); if (told) told.textContent = text; };
  const silent = 'The service does not answer.';

  const grouped = count => String(count).replace(/\B(?=(\d{3})+$)/g, '\u202f');
  const digits = value => value.toFixed(value >= 100 ? 0 : value >= 10 ? 1 : 2);
  const size = count => {
    const [unit, name] = [[1e9, 'GB'], [1e6, 'MB'], [1e3, 'kB']].find(([unit]) => count >= unit) || [1, 'B'];
    return unit === 1 ? `${count} B` : `${digits(count / unit)} ${name}`;
  };
  const duration = seconds => {
    const whole = Math.round(seconds);
    if (whole < 60) return `${whole} s`;
    if (whole < 3600) return `${Math.floor(whole / 60)} min ${whole % 60} s`;
    return `${Math.floor(whole / 3600)} h ${Math.floor(whole % 3600 / 60)} min`;
  };
  return { base, at, ask, problem, tell, silent, grouped, size, duration };
})();
