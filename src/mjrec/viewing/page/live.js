// Follows a run: polls the server for new states, lists episodes, draws their returns.
"use strict";
(() => {
  const about = JSON.parse(document.getElementById("replay-data").textContent);
  if (!about.live) return;
  const element = (id) => document.getElementById(id);
  const asked = new URLSearchParams(location.search);
  const token = asked.get("token");
  const replay = () => window.mjrecReplay;
  let episode = about.episode, wanted = episode, known = 0, hasMore = false, returns = [];

  async function ask(page, options = {}) {
    const query = new URLSearchParams({ token, ...options });
    const answer = await fetch(`${page}?${query}`);
    if (!answer.ok) throw new Error(answer.statusText);
    const told = await answer.json();
    if (told.error) throw new Error(told.error);
    return told;
  }

  async function motion() {
    if (wanted !== episode) {
      episode = wanted;
      known = 0;
    }
    const told = await ask("/motion", { episode, from: known });
    if (told.scene !== about.scene) {
      // The scene makes the address another one, so that the page is loaded again.
      const follow = element("live-follow").checked;
      location.search = new URLSearchParams({ token, episode, follow, scene: told.scene });
      return;
    }
    if (known === 0) replay().begin(told);
    if (told.chunk) await replay().append(told.chunk);
    known = told.next;
    hasMore = told.hasMore;
    replay().tell(told);
    if (told.chunk) replay().newest(element("live-follow").checked);
  }

  async function list() {
    const told = await ask("/episodes");
    returns = told.returns;
    const cut = told.episodes.filter((each) => each.running === false).length;
    const early = cut ? `; ended early: ${cut}` : "";
    element("live-count").textContent = `Complete episodes: ${told.count}${early}`;
    const rows = told.episodes.toReversed().map((each) => {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = "running" in each
        ? `${each.label}: ${each.running ? "running" : "ended early"}`
        : `${each.label}: ${each.length} steps, return ${each.return?.toPrecision(5) ?? "NaN"}`;
      button.setAttribute("aria-pressed", each.name === episode);
      button.addEventListener("click", () => {
        element("live-follow").checked = false;
        wanted = each.name;
      });
      const item = document.createElement("li");
      item.append(button);
      return item;
    });
    element("live-episodes").replaceChildren(...rows);
    draw();
    const newest = told.episodes.at(-1)?.name;
    if (element("live-follow").checked && newest) wanted = newest;
  }

  function draw() {
    const canvas = element("live-returns");
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    canvas.width = width;
    canvas.height = height;
    const context = canvas.getContext("2d");
    const finite = returns.filter(Number.isFinite);
    const low = Math.min(...finite), high = Math.max(...finite);
    context.fillStyle = "#2563a8";
    returns.forEach((each, index) => {
      if (!Number.isFinite(each)) return;
      const x = 2 + ((width - 5) * index) / Math.max(1, returns.length - 1);
      const y = 2 + (height - 5) * (1 - (each - low) / (high - low || 1));
      context.fillRect(x - 1, y - 1, 3, 3);
    });
    const range = finite.length ? `, from ${low.toPrecision(4)} to ${high.toPrecision(4)}` : "";
    canvas.setAttribute("aria-label", `Returns of ${returns.length} episodes${range}`);
  }

  // The next request waits several times as long as the last answer took.
  async function forever(question, pause) {
    for (;;) {
      const begin = performance.now();
      try {
        if (replay()) await question();
        element("live-problem").textContent = "";
      } catch (error) {
        element("live-problem").textContent = `No answer: ${error.message}`;
      }
      const took = performance.now() - begin;
      const wait = question === motion && hasMore ? took : Math.max(pause, 4 * took);
      await new Promise((done) => setTimeout(done, wait));
    }
  }

  element("live").hidden = false;
  element("live-follow").checked = asked.get("follow") !== "false";
  forever(motion, 300);
  forever(list, 1000);
})();
