"use strict";
(() => {
  const one = (selector, root = document) => root.querySelector(selector);
  const all = (selector, root = document) => [...root.querySelectorAll(selector)];
  const PAGE = 100;
  const DASH = "–";
  const text = new Intl.Collator("en", { numeric: true });

  function say(words) {
    const place = one("#said");
    place.textContent = "";
    // A screen reader announces changes, not repeated text.
    setTimeout(() => { place.textContent = words; }, 50);
  }

  // --- Sorting --------------------------------------------------------------------

  // Put a button into each heading that calls `sort` with the column and direction.
  function makeSortable(table, sort) {
    const headings = all("thead th", table);
    headings.forEach((heading, column) => {
      const button = document.createElement("button");
      button.type = "button";
      button.append(...heading.childNodes);
      heading.append(button);
      button.addEventListener("click", () => {
        const before = heading.getAttribute("aria-sort");
        const first = heading.dataset.kind === "number" ? "descending" : "ascending";
        const other = first === "descending" ? "ascending" : "descending";
        const way = before === first ? other : first;
        headings.forEach((h) => h.removeAttribute("aria-sort"));
        heading.setAttribute("aria-sort", way);
        sort(heading, column, way === "ascending" ? 1 : -1);
        say(`Sorted by ${button.textContent.trim()}, ${way}`);
      });
    });
  }

  function sortSummary(table) {
    const body = one("tbody", table);
    const rows = all("tr", body);
    makeSortable(table, (heading, column, way) => {
      const isNumber = heading.dataset.kind === "number";
      const keyed = rows.map((row, i) => {
        const cell = row.cells[column];
        if (!isNumber) return { row, i, key: cell.textContent.trim() };
        return { row, i, key: cell.dataset.value === "" ? NaN : Number(cell.dataset.value) };
      });
      keyed.sort((a, b) => (isNumber ? byNumber(a.key, b.key, way) : way * text.compare(a.key, b.key)) || a.i - b.i);
      body.append(...keyed.map((k) => k.row));
    });
  }

  // Unknown values come last in either direction.
  function byNumber(a, b, way) {
    const aIs = a === a, bIs = b === b;
    if (aIs && bIs) return a < b ? -way : a > b ? way : 0;
    return aIs ? -1 : bIs ? 1 : 0;
  }

  // --- The gallery ----------------------------------------------------------------

  function startGallery(form) {
    const cards = all("#gallery > .card");
    const task = one("#gallery-task");
    const count = one("#gallery-count");
    function show() {
      const role = one("input[name=role]:checked", form)?.value ?? "";
      let shown = 0;
      for (const card of cards) {
        const fits = (!task?.value || card.dataset.task === task.value)
          && (!role || card.dataset.roles.split(" ").includes(role));
        card.hidden = !fits;
        if (fits) shown += 1;
        else one("video", card)?.pause();
      }
      count.textContent = `${shown} of ${cards.length} videos`;
    }
    form.addEventListener("change", show);
    form.addEventListener("submit", (event) => event.preventDefault());
    // A browser may restore the selection when the page is reloaded.
    window.addEventListener("pageshow", show);
    form.hidden = false;
    show();
    return () => { form.reset(); show(); };
  }

  function playOneAtATime() {
    document.addEventListener("play", (event) => {
      all("video").forEach((video) => { if (video !== event.target) video.pause(); });
    }, true);
  }

  // Creating a player takes milliseconds, and there may be hundreds, so each is created
  // on demand. Until then there is a button in its place; without this script, a link.
  function playWhenAsked() {
    for (const link of all("a.play")) {
      const button = document.createElement("button");
      button.type = "button";
      button.className = "play";
      button.append(...link.childNodes);
      button.addEventListener("click", () => {
        const video = playerOf(link, button);
        button.replaceWith(video);
        video.focus({ preventScroll: true });
        video.play().catch(() => {});
      });
      link.replaceWith(button);
    }
  }

  function playerOf(link, button) {
    const video = document.createElement("video");
    const picture = one("img", button);
    if (picture) {
      video.poster = picture.src;
      for (const name of ["width", "height"]) {
        if (picture.hasAttribute(name)) video.setAttribute(name, picture.getAttribute(name));
      }
    }
    video.controls = true;
    video.playsInline = true;
    video.tabIndex = 0;
    video.setAttribute("aria-label", one("bdi", button).textContent);
    video.src = link.href;
    return video;
  }

  // --- Copying --------------------------------------------------------------------

  function select(element) {
    const range = document.createRange();
    range.selectNodeContents(element);
    const selection = getSelection();
    selection.removeAllRanges();
    selection.addRange(range);
  }

  async function copy(element) {
    try {
      await navigator.clipboard.writeText(element.textContent);
      return true;
    } catch {
      // A page opened from disk may lack permission.
      select(element);
      try { return document.execCommand("copy"); } catch { return false; }
    }
  }

  function addCopyButtons() {
    for (const place of all("[data-copy]")) {
      const button = document.createElement("button");
      button.type = "button";
      button.className = "copy";
      button.textContent = "Copy";
      button.setAttribute("aria-label", `Copy the ${place.dataset.copy}`);
      button.addEventListener("click", async () => {
        const done = await copy(one("code", place));
        button.textContent = done ? "Copied" : "Selected";
        say(done ? `The ${place.dataset.copy} is copied` : `The ${place.dataset.copy} is selected: copy it with Ctrl+C`);
        setTimeout(() => { button.textContent = "Copy"; }, 2000);
      });
      place.append(button);
    }
  }

  // --- All episodes ---------------------------------------------------------------

  function startEpisodes(showCard) {
    const { tasks, outcomes } = JSON.parse(one("#episodes-data").textContent);
    const sizes = tasks.map((t) => t.episode.length);
    const total = sizes.reduce((a, b) => a + b, 0);
    const taskOf = new Int32Array(total), within = new Int32Array(total);
    let at = 0;
    tasks.forEach((t, i) => {
      taskOf.fill(i, at, at + sizes[i]);
      for (let j = 0; j < sizes[i]; j += 1) within[at + j] = j;
      at += sizes[i];
    });
    // The alphabetical rank of each name, so that names sort like numbers.
    const places = (names) => {
      const order = names.map((_, i) => i).sort((a, b) => text.compare(names[a], names[b]) || a - b);
      const place = new Array(names.length);
      order.forEach((i, p) => { place[i] = p; });
      return place;
    };
    const of = {
      task: () => { const place = places(tasks.map((t) => t.name)); return (t) => place[t]; },
      run: () => { const place = tasks.map((t) => t.runs && places(t.runs)); return (t, i) => { const run = tasks[t].run[i]; return place[t] ? place[t][run] : run; }; },
      outcome: () => { const place = places(outcomes); return (t, i) => place[tasks[t].outcome[i]]; },
      success: () => (t, i) => (tasks[t].success[i] < 0 ? NaN : tasks[t].success[i]),
      videos: () => (t, i) => (tasks[t].videos[i] ? tasks[t].videos[i].length : 0),
    };
    const keys = {};
    function keysOf(name) {
      if (keys[name]) return keys[name];
      const key = of[name] ? of[name]() : (t, i) => tasks[t][name][i] ?? NaN;
      const made = new Float64Array(total);
      for (let n = 0; n < total; n += 1) made[n] = key(taskOf[n], within[n]);
      keys[name] = made;
      return made;
    }

    const table = one("#episodes-table");
    const body = one("tbody", table);
    const hasSuccesses = one("[data-key=success]", table) !== null;
    const count = one("#episodes-count");
    const previous = one("#episodes-previous"), next = one("#episodes-next");
    const chosen = one("#episodes-task");
    let order = new Uint32Array(0), first = 0, sorted = null;

    function choose() {
      const only = chosen?.value ?? "";
      const rows = [];
      for (let n = 0; n < total; n += 1) if (only === "" || taskOf[n] === Number(only)) rows.push(n);
      order = Uint32Array.from(rows);
      if (sorted) {
        const key = keysOf(sorted.name), way = sorted.way;
        order.sort((a, b) => byNumber(key[a], key[b], way) || a - b);
      }
      first = 0;
      show();
    }

    function cell(row, words, isNumber) {
      const made = row.insertCell();
      if (isNumber) made.className = "n";
      made.textContent = words;
      return made;
    }

    function formats(decimals) {
      const format = new Intl.NumberFormat("en", { minimumFractionDigits: decimals, maximumFractionDigits: decimals, useGrouping: "min2" });
      return (value) => (value === null ? DASH : Math.abs(value) >= 1e15 ? value.toPrecision(4) : format.format(value).replaceAll(",", "\u202f"));
    }
    const whole = formats(0);
    const shown = tasks.map((t) => formats(t.decimals));

    function makeRow(n) {
      const t = tasks[taskOf[n]], i = within[n];
      const row = document.createElement("tr");
      const name = document.createElement("span");
      name.dir = "auto";
      name.className = "name";
      name.textContent = t.name;
      cell(row, "").append(name);
      // Shown in this column, because on a phone those to the right are off-screen.
      const outcome = cell(row, outcomes[t.outcome[i]] || DASH);
      if (t.failures[i]) outcome.textContent += `: ${t.failures[i]}`;
      if (outcomes[t.outcome[i]] === "failed") outcome.className = "bad";
      cell(row, t.runs ? t.runs[t.run[i]] : t.run[i]).dir = "auto";
      cell(row, t.episode[i], true);
      cell(row, shown[taskOf[n]](t.total_reward[i]), true);
      cell(row, whole(t.length[i]), true);
      if (hasSuccesses) cell(row, t.success[i] < 0 ? DASH : t.success[i] ? "yes" : "no");
      const videos = cell(row, "");
      (t.videos[i] ?? []).forEach((place, k) => {
        const link = document.createElement("a");
        link.href = place;
        link.textContent = k ? ` ${k + 1}` : "video";
        link.setAttribute("aria-label", `Video ${k + 1} of ${t.name}, episode ${t.episode[i]}`);
        // Browsers do not navigate to `data:` URLs.
        if (place.startsWith("data:")) link.download = "";
        if (place.startsWith("#")) link.addEventListener("click", () => showCard(place));
        videos.append(link);
      });
      return row;
    }

    function show() {
      const last = Math.min(first + PAGE, order.length);
      const rows = document.createDocumentFragment();
      for (let k = first; k < last; k += 1) rows.append(makeRow(order[k]));
      body.replaceChildren(rows);
      count.textContent = order.length ? `Rows ${whole(first + 1)} to ${whole(last)} of ${whole(order.length)}` : "No episodes";
      previous.setAttribute("aria-disabled", String(first === 0));
      next.setAttribute("aria-disabled", String(last === order.length));
    }

    previous.addEventListener("click", () => { if (first > 0) { first -= PAGE; show(); } });
    next.addEventListener("click", () => { if (first + PAGE < order.length) { first += PAGE; show(); } });
    chosen?.addEventListener("change", choose);
    makeSortable(table, (heading, _, way) => { sorted = { name: heading.dataset.key, way }; choose(); });
    one("#episodes-tools").hidden = false;
    one("#episodes-region").hidden = false;
    choose();
  }

  // --- Paper ----------------------------------------------------------------------

  function printPosters() {
    const controls = (there) => all("video").forEach((video) => { video.controls = there; });
    addEventListener("beforeprint", () => controls(false));
    addEventListener("afterprint", () => controls(true));
  }

  const form = one("#gallery-filter");
  const reset = form ? startGallery(form) : () => {};
  sortSummary(one("#summary-table"));
  startEpisodes((place) => { if (one(place)?.hidden) reset(); });
  playOneAtATime();
  playWhenAsked();
  addCopyButtons();
  printPosters();
})();
