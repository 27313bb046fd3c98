// Plays recorded states in viser's scene: it moves viser's nodes and adds its own
// controls. viser exposes `__viserMutable` for page tests; our tests read back the parts
// of it that are used here.
"use strict";
(() => {
  const about = JSON.parse(document.getElementById("replay-data").textContent);
  const element = (id) => document.getElementById(id);
  const frames = []; // one per state: views of the chunks' arrays
  const colours = new Map(); // by name: [[state, [r, g, b, a]], ...]
  const shown = new Map(); // by name: the node's current colour
  let current = 0, playing = false, clock = 0, followed = null, viewer = null;
  const free = { position: null };

  // --- Data --------------------------------------------------------------------

  async function unpack(text, kind = Float32Array) {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new kind(await new Response(stream).arrayBuffer());
  }

  async function append(chunk) {
    const data = await unpack(chunk.data);
    const { names, scaled } = chunk;
    const index = new Map(names.map((name, place) => [name, place]));
    const soft = Object.entries(chunk.vertices).map(([name, count]) => [name, 3 * count]);
    const sizes = [
      4, 3, 8 * about.cameras.length, 7 * names.length, 3 * scaled.length,
      ...soft.map(([, size]) => size),
    ];
    const width = sizes.reduce((sum, size) => sum + size, 0);
    const first = frames.length;
    for (let row = 0; row < chunk.count; row++) {
      let at = row * width;
      const [numbers, target, cameras, poses, scales, ...rest] = sizes.map((size) => {
        at += size;
        return data.subarray(at - size, at);
      });
      const [step, time, reward, total] = numbers;
      const vertices = Object.fromEntries(soft.map(([name], place) => [name, rest[place]]));
      const moved = { target, cameras, poses, scales, vertices };
      frames.push({ names, scaled, index, step, time, reward, total, ...moved });
    }
    for (const [state, name, rgba] of chunk.colours) {
      if (!colours.has(name)) colours.set(name, [[-1, about.rgba[name]]]);
      colours.get(name).push([first + state, rgba]);
    }
    element("replay-place").max = frames.length - 1;
  }

  // --- The scene ---------------------------------------------------------------

  function show(state) {
    current = Math.max(0, Math.min(frames.length - 1, state));
    const frame = frames[current];
    frame.names.forEach((name, index) => {
      const [x, y, z, ...wxyz] = frame.poses.subarray(7 * index, 7 * index + 7);
      if (name.startsWith("bone/")) return;
      viewer.nodePoseData[name] = { wxyz, position: [x, y, z], poseUpdateState: "needsUpdate" };
    });
    frame.scaled.forEach((name, index) => {
      const node = viewer.nodeRefFromName[name];
      const size = frame.scales.subarray(3 * index, 3 * index + 3);
      // What is not there in this state gets no size: viser decides what is visible.
      if (node) node.scale.set(...size.map((each) => each || (size[0] > 0 ? 1 : 1e-9)));
    });
    for (const name of Object.keys(about.skins)) bend(name, frame);
    for (const [name, places] of Object.entries(frame.vertices)) {
      const geometry = geometryOf(name);
      if (geometry) putVertices(geometry, (out) => out.set(places));
    }
    for (const [name, changes] of colours) paint(name, changes);
    aim(frame);
    write(frame);
    viewer.requestRender();
  }

  // The geometry of a node's mesh, which holds its vertices.
  function geometryOf(name) {
    let found = null;
    viewer.nodeRefFromName[name]?.traverse((part) => {
      if (part.isMesh && !part.material.isShadowMaterial) found ??= part;
    });
    if (!found) return null;
    found.frustumCulled = false;
    return found.geometry;
  }

  function putVertices(geometry, write) {
    const places = geometry.attributes.position;
    write(places.array);
    places.needsUpdate = true;
    geometry.computeVertexNormals();
  }

  // Linear blend skinning with all weights, like MuJoCo: viser allows four per vertex.
  function bend(name, frame) {
    const skin = about.skins[name], geometry = geometryOf(name);
    if (!geometry) return;
    skin.rest ??= geometry.attributes.position.array.slice();
    putVertices(geometry, (out) => {
      out.fill(0);
      let at = 0;
      skin.bones.forEach((bone, index) => {
        const pose = poseOf(frame, bone), bind = skin.bind.subarray(7 * index, 7 * index + 7);
        const [w, x, y, z] = bind.subarray(3);
        const turn = product(pose.slice(3), [w, -x, -y, -z]);
        const columns = [[1, 0, 0], [0, 1, 0], [0, 0, 1]].map((axis) => rotated(turn, axis));
        const moved = rotated(turn, bind);
        for (const end = at + skin.counts[index]; at < end; at++) {
          const vertex = 3 * skin.ids[at], weight = skin.weights[at];
          for (let i = 0; i < 3; i++) {
            let place = pose[i] - moved[i];
            for (let j = 0; j < 3; j++) place += columns[j][i] * skin.rest[vertex + j];
            out[vertex + i] += weight * place;
          }
        }
      });
    });
  }

  function poseOf(frame, name) {
    const place = frame.index.get(name);
    return place === undefined
      ? about.still[name]
      : frame.poses.subarray(7 * place, 7 * place + 7);
  }

  function paint(name, changes) {
    let rgba = changes[0][1];
    for (const [state, next] of changes) if (state <= current) rgba = next;
    const node = viewer.nodeRefFromName[name];
    if (!node || shown.get(name) === rgba) return;
    node.traverse((part) => {
      if (!part.material?.color || part.material.isShadowMaterial) return;
      part.material.color.setRGB(rgba[0], rgba[1], rgba[2]);
      part.material.opacity = rgba[3];
      part.material.transparent = rgba[3] < 1;
      part.material.depthWrite = rgba[3] === 1;
      // Opaque materials are compiled without opacity.
      part.material.needsUpdate = true;
      shown.set(name, rgba);
    });
  }

  // --- Cameras -----------------------------------------------------------------

  // z is up in MuJoCo and y in three.js, so viser rotates the root of its scene.
  const turned = (vector) => rotated(viewer.nodePoseData[""].wxyz, vector);

  function rotated([w, x, y, z], [a, b, c]) {
    const [t, u, v] = [2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)];
    return [a + w * t + y * v - z * u, b + w * u + z * t - x * v, c + w * v + x * u - y * t];
  }

  function product([a, b, c, d], [w, x, y, z]) {
    return [
      a * w - b * x - c * y - d * z, a * x + b * w + c * z - d * y,
      a * y - b * z + c * w + d * x, a * z + b * y - c * x + d * w,
    ];
  }

  function look(position, target, up, fovy) {
    const control = viewer.cameraControl;
    viewer.camera.up.set(...turned(up));
    control.updateCameraUp();
    control.setLookAt(...turned(position), ...turned(target), false);
    control.update(0);
    viewer.camera.fov = fovy;
    viewer.camera.updateProjectionMatrix();
  }

  function aim(frame) {
    const chosen = element("replay-camera").value;
    const control = viewer.cameraControl;
    const target = Array.from(frame.target);
    if (chosen === "track") {
      if (followed) {
        const move = turned(target.map((each, i) => each - followed[i]));
        const position = control.getPosition().toArray().map((each, i) => each + move[i]);
        const lookAt = control.getTarget().toArray().map((each, i) => each + move[i]);
        control.setLookAt(...position, ...lookAt, false);
        control.update(0);
      }
      followed = target;
    } else if (chosen !== "free") {
      const number = Number(chosen);
      const pose = Array.from(frame.cameras.subarray(8 * number, 8 * number + 8));
      const [position, wxyz] = [pose.slice(0, 3), pose.slice(3, 7)];
      const ahead = rotated(wxyz, [0, 0, -1]);
      const distance = about.extent;
      look(
        position, position.map((each, i) => each + distance * ahead[i]),
        rotated(wxyz, [0, 1, 0]), pose[7],
      );
    }
  }

  function chooseCamera(value) {
    const select = element("replay-camera");
    const isFree = (each) => each === "free" || each === "track";
    const before = select.dataset.before;
    select.value = value;
    if (select.value !== value) select.value = "free";
    if (isFree(select.value) && !isFree(before)) {
      const { position, target, fovy } = about.view;
      // At first, the free camera is where the environment has put it.
      const isFirst = before === undefined && value === "free";
      const at = isFirst ? about.start : Array.from(frames[current].target);
      const move = at.map((each, i) => each - about.start[i]);
      const moved = (point) => point.map((each, i) => each + move[i]);
      look(moved(position), moved(target), [0, 0, 1], fovy);
    }
    viewer.cameraControl.enabled = isFree(select.value);
    select.dataset.before = select.value;
    followed = null;
    show(current);
  }

  // --- Controls ----------------------------------------------------------------

  const digits = (value) => Number(value.toPrecision(5)).toString();

  function text(frame) {
    const place = `step ${frame.step} of ${about.steps}, ${frame.time.toFixed(2)} s`;
    return about.hasRewards
      ? `${place}, reward ${digits(frame.reward)}, return ${digits(frame.total)}`
      : place;
  }

  function write(frame) {
    const slider = element("replay-place");
    slider.value = current;
    slider.setAttribute("aria-valuetext", text(frame));
    element("replay-where").textContent = text(frame);
    const isLast = current === frames.length - 1;
    element("replay-ending").textContent = isLast ? about.ending : "";
    draw();
  }

  function draw(cursor = null) {
    const canvas = element("replay-curve");
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    canvas.width = width * devicePixelRatio;
    canvas.height = height * devicePixelRatio;
    const context = canvas.getContext("2d");
    context.scale(devicePixelRatio, devicePixelRatio);
    const totals = frames.map((frame) => frame.total).filter(Number.isFinite);
    const low = Math.min(0, ...totals), high = Math.max(0, ...totals);
    const x = (state) => 1 + ((width - 3) * state) / Math.max(1, frames.length - 1);
    const y = (total) => 3 + (height - 6) * (1 - (total - low) / (high - low || 1));
    context.strokeStyle = "#2563a8";
    context.beginPath();
    frames.forEach((frame, state) => context.lineTo(x(state), y(frame.total)));
    context.stroke();
    if (about.ending) rule(context, x(frames.length - 1), height, "#b4232a");
    rule(context, x(current), height, "#1c2430");
    if (cursor === null) return;
    rule(context, x(cursor), height, "#8a94a3");
    context.fillStyle = "#1c2430";
    context.font = "12px system-ui, sans-serif";
    const isRight = x(cursor) > width / 2;
    context.textAlign = isRight ? "right" : "left";
    context.fillText(text(frames[cursor]), x(cursor) + (isRight ? -6 : 6), 14);
  }

  function rule(context, x, height, colour) {
    context.fillStyle = colour;
    context.fillRect(x - 0.5, 0, 1.5, height);
  }

  function play(on) {
    playing = on;
    if (on && current === frames.length - 1) show(0);
    clock = frames[current].time;
    const button = element("replay-play");
    button.textContent = on ? "Pause" : "Play";
    if (!on) keep();
  }

  let before = performance.now();
  function tick(now) {
    // On a slow machine the replay slows down instead of jumping to the end.
    const seconds = Math.min(0.25, (now - before) / 1000);
    before = now;
    if (playing) {
      clock += seconds * Number(element("replay-speed").value);
      let state = current;
      while (state < frames.length - 1 && frames[state + 1].time <= clock) state++;
      if (state !== current) show(state);
      if (state === frames.length - 1) play(false);
    }
    requestAnimationFrame(tick);
  }

  function go(state) {
    play(false);
    show(state);
    keep();
  }

  // --- The URL's fragment --------------------------------------------------------

  function keep() {
    const place = new URLSearchParams({
      step: frames[current].step,
      camera: element("replay-camera").value,
      speed: element("replay-speed").value,
    });
    if (location.hash.slice(1) !== place.toString()) location.replace(`#${place}`);
  }

  function restore() {
    const place = new URLSearchParams(location.hash.slice(1));
    if (place.has("speed")) element("replay-speed").value = place.get("speed");
    if (!element("replay-speed").value) element("replay-speed").value = "1";
    const step = Number(place.get("step") ?? 0);
    let state = frames.findLastIndex((frame) => frame.step <= step);
    if (state < 0) state = 0;
    current = state;
    chooseCamera(place.get("camera") ?? about.camera);
  }

  // --- Keys --------------------------------------------------------------------

  const changeSpeed = (by) => {
    const select = element("replay-speed");
    const next = select.selectedIndex + by;
    select.selectedIndex = Math.max(0, Math.min(select.length - 1, next));
    keep();
  };
  const nextCamera = () => {
    const { options, selectedIndex } = element("replay-camera");
    chooseCamera(options[(selectedIndex + 1) % options.length].value);
    keep();
  };
  const keys = {
    " ": () => play(!playing),
    ",": () => go(current - 1),
    ".": () => go(current + 1),
    Home: () => go(0),
    End: () => go(frames.length - 1),
    "[": () => changeSpeed(-1),
    "]": () => changeSpeed(1),
    c: nextCamera,
    "?": () => { element("replay-keys").hidden = !element("replay-keys").hidden; },
    Escape: () => { element("replay-keys").hidden = true; },
  };

  function listen() {
    document.addEventListener("keydown", (event) => {
      const isTyping = event.target.matches("input:not([type=range]), textarea");
      const isControl = event.target.matches("button, select") && event.key === " ";
      const action = keys[event.key];
      if (!action || isTyping || isControl || event.ctrlKey || event.metaKey) return;
      event.preventDefault();
      action();
    });
    element("replay-place").addEventListener("input", (event) => go(Number(event.target.value)));
    element("replay-play").addEventListener("click", () => play(!playing));
    element("replay-speed").addEventListener("change", keep);
    element("replay-camera").addEventListener("change", (event) => {
      chooseCamera(event.target.value);
      keep();
    });
    element("replay-help").addEventListener("click", keys["?"]);
    const curve = element("replay-curve");
    const under = (event) =>
      Math.max(0, Math.min(frames.length - 1,
        Math.round((event.offsetX / curve.clientWidth) * (frames.length - 1))));
    curve.addEventListener("pointermove", (event) => draw(under(event)));
    curve.addEventListener("pointerleave", () => draw());
    curve.addEventListener("click", (event) => go(under(event)));
    addEventListener("resize", () => draw());
    addEventListener("hashchange", restore);
  }

  // --- Loading an episode, and more of its states: for live.js ---------------------

  function begin({ rgba, start }) {
    frames.length = 0;
    colours.clear();
    for (const [name, each] of Object.entries(rgba)) {
      if (String(each) !== String(shown.get(name) ?? about.rgba[name])) {
        colours.set(name, [[-1, each]]);
      }
    }
    about.rgba = rgba;
    about.start = start ?? about.start;
    followed = null;
  }

  function tell({ steps, ending, title }) {
    about.steps = steps;
    about.ending = ending;
    document.title = title;
    element("replay-title").textContent = title;
  }

  function newest(isWanted) {
    if (isWanted) playing = false;
    if (frames.length) show(isWanted ? frames.length - 1 : current);
  }

  // --- Start -------------------------------------------------------------------

  function isThere() {
    viewer = window.__viserMutable;
    return viewer?.cameraControl && about.nodes.every((name) => viewer.nodeRefFromName[name]);
  }

  async function start() {
    await append(about.chunk);
    for (const skin of Object.values(about.skins)) {
      skin.bind = await unpack(skin.bind);
      skin.ids = await unpack(skin.ids, Int32Array);
      skin.weights = await unpack(skin.weights);
    }
    while (!isThere()) await new Promise((done) => setTimeout(done, 30));
    listen();
    restore();
    requestAnimationFrame(tick);
    window.mjrecReplay = { append, begin, tell, newest };
    document.documentElement.dataset.replay = "ready";
  }
  start();
})();
