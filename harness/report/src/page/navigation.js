// The list of scenarios: search, filters, groups and keys. The anchors and `:target` of the style sheet select a scenario.
"use strict";
(() => {
  const list = document.querySelector("nav.list ol"), box = document.querySelector("nav.list .filters");
  if (!list || !list.children.length) return;
  const entries = [...list.children];
  const element = (tag, attributes) => Object.assign(document.createElement(tag), attributes);
  const values = (entry, key) => (entry.dataset[key] || "").split("\n").filter(Boolean);

  const search = element("input", { type: "search", placeholder: "Search (key /)", ariaLabel: "Search scenarios" });
  const selects = ["verdict", "folder", "law", "tag", "requirement"].flatMap((key) => {
    const known = [...new Set(entries.flatMap((entry) => values(entry, key)))].sort();
    if (known.length < 2) return [];
    const select = element("select", { ariaLabel: "Filter by " + key });
    select.append(new Option("any " + key, ""), ...known.map((value) => new Option(value, value)));
    return [[key, select]];
  });
  const group = element("select", { ariaLabel: "Group" });
  group.append(new Option("no groups", ""), ...selects.filter(([key]) => ["verdict", "folder", "law"].includes(key)).map(([key]) => new Option("by " + key, key)));
  const count = element("p", { className: "count", ariaLive: "polite" });
  box.append(search, ...selects.map(([, select]) => select), group, count);

  function update() {
    const words = search.value.toLowerCase().split(/\s+/).filter(Boolean);
    const visible = entries.filter((entry) => {
      const text = [entry.querySelector(".name").textContent, ...Object.values(entry.dataset)].join(" ").toLowerCase();
      return words.every((word) => text.includes(word)) && selects.every(([key, { value }]) => !value || values(entry, key).includes(value));
    });
    const of = (entry) => group.value ? entry.dataset[group.value] : "";
    const names = [...new Set(visible.map(of))];
    list.replaceChildren(...names.flatMap((name) => [
      ...(group.value ? [element("li", { className: "group", textContent: name })] : []), ...visible.filter((entry) => of(entry) === name),
    ]));
    count.textContent = `${visible.length} of ${entries.length} scenarios. Keys: j next, k previous, / search`;
  }

  function mark() {
    for (const entry of entries) {
      const link = entry.firstElementChild;
      if (link.hash !== location.hash) { link.removeAttribute("aria-current"); continue; }
      link.setAttribute("aria-current", "page");
      link.scrollIntoView({ block: "nearest" });
    }
    scrollTo(0, 0);
  }

  function move(step) {
    const visible = [...list.querySelectorAll("a")];
    const at = visible.findIndex((link) => link.hash === location.hash);
    const next = visible[at < 0 ? (step > 0 ? 0 : visible.length - 1) : at + step];
    if (next) location.hash = next.hash;
  }

  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.target.matches("input, select")) { if (event.key === "Escape") event.target.blur(); return; }
    const acts = { j: () => move(1), k: () => move(-1), "/": () => search.focus() };
    if (!acts[event.key]) return;
    event.preventDefault();
    acts[event.key]();
  });
  box.addEventListener("input", update);
  addEventListener("hashchange", mark);
  update();
  mark();
})();
