// The theme that was chosen, before anything is painted: a module would come too late for that.
try {
  const chosen = localStorage.getItem("sceneprint.theme");
  if (chosen === "light" || chosen === "dark") document.documentElement.dataset.theme = chosen;
} catch { /* storage is forbidden here: the system's theme it is */ }
