"use strict";
(async () => {
  const root = document.documentElement;
  if (typeof DecompressionStream === "undefined") {
    root.dataset.ready = "old";
    return;
  }
  root.classList.add("live");
  for (const code of document.querySelectorAll(".repeat pre code")) code.replaceChildren(...unbroken(code.textContent));
  const page = JSON.parse(await text("data"));
  if (page.tasks.length) {
    window.explorer = new Explorer(document.getElementById("player"), page.tasks, await unpacked("numbers"));
  }
  await startCharts(page.charts);
  root.dataset.ready = "yes";
})();
