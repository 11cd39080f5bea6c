// What must not wait for modules: the theme, before anything is painted, and the modules of the first page, which
// are fetched with those of the shell rather than one after the other.
try {
  const chosen = localStorage.getItem("sceneprint.theme");
  if (chosen === "light" || chosen === "dark") document.documentElement.dataset.theme = chosen;
} catch { /* storage is forbidden here: the system's theme it is */ }
if (/^(#\/?)?$/.test(location.hash)) {
  for (const name of ["maps/maps", "maps/card", "maps/condition", "maps/thumbnail", "lib/labels", "lib/palette", "lib/picture", "lib/statuses"]) {
    document.head.append(Object.assign(document.createElement("link"), { rel: "modulepreload", href: `dashboard/${name}.js` }));
  }
}
