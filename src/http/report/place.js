'use strict';
// A proxy may serve the page below a path that the service does not know, and the page itself does.
(() => {
  const viewer = document.getElementById('viewer');
  if (viewer && location.pathname.endsWith('/report')) viewer.dataset.href = location.pathname.replace(/report$/, 'view');
})();
