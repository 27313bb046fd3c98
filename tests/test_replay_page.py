# SPDX-License-Identifier: Apache-2.0
"""Replays: files that show recorded episodes in 3D, opened in headless Chromium."""

import contextlib
import html
import io
import logging
import re
import subprocess
import sys

import gymnasium
import mujoco
import numpy as np
import pytest
from browsers import barriers_of, chromium, complaints_of, data_of, served
from parts import parametrize
from PIL import Image
from robots import robots_that_reset
from waiting import wait_until

import mjrec
from mjrec.commands import main
from mjrec.errors import UnreadableFile

pytest.importorskip("viser")
pytest.importorskip("mjviser")
from mjrec.viewing.episodes import recorded_episodes
from mjrec.viewing.geometry import mesh_of
from mjrec.viewing.motion import OWN_LIGHTS, Shape

_STEPS = 12
# They have meshes, skins, height fields, tendons, mocap bodies, hundreds of geoms.
_ENVIRONMENTS = (
    *("FetchReach-v4", "dm_control/ball_in_cup-catch"),
    *("Humanoid-v5", "Ant-v5", "Pusher-v5", "FetchPickAndPlace-v4"),
    *("AdroitHandDoor-v1", "HandManipulateBlock-v1"),
    *("dm_control/dog-run", "dm_control/quadruped-escape"),
    "dm_control/fish-swim",
)

# A tendon around a cylinder and a cloth change their shapes.
_SOFT = """
<mujoco>
  <worldbody>
    <geom type="plane" size="2 2 .1"/>
    <site name="above" pos="0 0 1"/>
    <geom name="pulley" type="cylinder" size=".1 .1" pos=".15 0 .7" euler="90 0 0"/>
    <body pos=".3 0 .4">
      <freejoint/> <geom size=".05"/> <site name="below"/>
    </body>
    <flexcomp name="cloth" type="grid" dim="2" count="4 4 1" spacing=".1 .1 .1"
      pos="1 0 .5" radius=".01" mass=".1"/>
  </worldbody>
  <tendon>
    <spatial width=".01">
      <site site="above"/> <geom geom="pulley"/> <site site="below"/>
    </spatial>
  </tendon>
</mujoco>
"""

_ROPE = """
<mujoco>
  <worldbody>
    <geom type="sphere" size=".1"/>
    <flexcomp name="rope" type="grid" dim="1" count="4 1 1" spacing=".1 .1 .1"
      pos="0 0 1" radius=".01" mass=".1"/>
  </worldbody>
</mujoco>
"""

# The mocap body comes first, as in Fetch.
_PICKER = """
<mujoco>
  <worldbody>
    <body name="hand" mocap="true" pos="9 0 0"><geom size=".1"/></body>
    <body pos="0 0 1">
      <body name="arm"><joint axis="0 1 0"/><geom size=".2" pos=".5 0 0"/></body>
    </body>
  </worldbody>
</mujoco>
"""

_BOX = """
<mujoco>
  <asset>
    <texture name="side" type="cube" file="side.png"/>
    <material name="side" texture="side"/>
  </asset>
  <worldbody><geom type="box" size=".1 .2 .3" material="side"/></worldbody>
</mujoco>
"""

# Returns the poses of the scene's nodes in the model's frame.
_POSES = """() => {
  const nodes = window.__viserMutable.nodeRefFromName;
  const shown = Object.entries(nodes).filter(([name]) => name.startsWith("/"));
  return Object.fromEntries(
    shown.map(([name, node]) => [name, [...node.position.toArray(),
      node.quaternion.w, node.quaternion.x, node.quaternion.y, node.quaternion.z]]));
}"""
_VERTICES = """(name, kind = "position") => {
  let found = null;
  window.__viserMutable.nodeRefFromName[name].traverse((part) => {
    if (part.isMesh) found ??= [...part.geometry.attributes[kind].array];
  });
  return found;
}"""
_NORMALS = f"(name) => ({_VERTICES})(name, 'normal')"
# Collects the text that the page writes on its curve.
_COLLECT_TEXT = """() => {
  window.drawnText = [];
  const context = CanvasRenderingContext2D.prototype, write = context.fillText;
  context.fillText = function (text, ...rest) {
    window.drawnText.push(text);
    write.call(this, text, ...rest);
  };
}"""
_SIZES = """(names) => names.map((name) => {
  return window.__viserMutable.nodeRefFromName[name].scale.toArray();
})"""
_CAMERA = """() => {
  const viewer = window.__viserMutable;
  const inverse = viewer.nodeRefFromName[""].quaternion.clone().invert();
  const place = (vector) => vector.clone().applyQuaternion(inverse).toArray();
  return [place(viewer.camera.position), viewer.camera.fov,
    place(viewer.cameraControl.getTarget())];
}"""
# Returns the places of the painted pixels, as fractions of the size.
_DOTS = """(canvas) => {
  const { width, height } = canvas;
  const { data } = canvas.getContext("2d").getImageData(0, 0, width, height);
  return Array.from({ length: width * height }, (_, at) => at)
    .filter((at) => data[4 * at + 3])
    .map((at) => [(at % width) / width, Math.floor(at / width) / height]);
}"""
_STEP = "Number(document.getElementById('replay-where').textContent.split(' ')[1])"
_AFTER_FRAMES = """async (count) => {
  for (; count > 0; count--) await new Promise(requestAnimationFrame);
}"""
_CAST_SHADOWS = """(casts) => {
  const nodes = Object.entries(window.__viserMutable.nodeRefFromName);
  for (const [name, node] of nodes) {
    if (!name.startsWith("/geom/")) continue;
    node.traverse((part) => {
      part.userData.casts ??= part.castShadow;
      part.castShadow = casts && part.userData.casts;
    });
  }
  window.__viserMutable.requestRender();
}"""
# Plays until a step is shown, and counts the images.
_IMAGES_UNTIL = f"""async (step) => {{
  document.getElementById("replay-play").click();
  let images = 0;
  for (; {_STEP} < step; images++) await new Promise(requestAnimationFrame);
  return images;
}}"""
_STEP_SHOWN = f"(step) => {_STEP} >= step"

# Records an endless episode.
_RUN = """
import sys, time, gymnasium, mjrec
env = gymnasium.make("HalfCheetah-v5", max_episode_steps=10**6)
env = mjrec.Monitor(env, sys.argv[1], workers=0, video_callable=lambda _: True)
env.reset(seed=0)
while True:
    env.step(env.action_space.sample())
    time.sleep(0.05)
"""


def record(name, directory, steps=_STEPS, change=lambda env, step: None, **options):
    """Record an episode without rendering it, and return its trajectory's path."""
    if name.startswith("dm_control/"):
        suite = pytest.importorskip("dm_control.suite")
        task = name.removeprefix("dm_control/").split("-")
        env = suite.load(*task, task_kwargs={"random": 0})
        draw, begin, facts = env.action_spec().generate_value, {}, {"env_id": name}
    else:
        env = gymnasium.make(name, **options)
        env.action_space.seed(0)
        draw, begin, facts = env.action_space.sample, {"seed": 0}, {}
    with mjrec.Monitor(env, directory, lambda _: True, workers=0, **facts) as monitor:
        monitor.reset(**begin)
        for step in range(1, steps + 1):
            change(env, step)
            monitor.step(draw())
    [path] = directory.glob("*.h5")
    return path


def files_in(directory):
    """Return the sizes and times of a directory's files."""
    found = {path: path.stat() for path in (directory, *directory.rglob("*"))}
    return {path: (each.st_size, each.st_mtime_ns) for path, each in found.items()}


def record_any(name, directory, steps=_STEPS):
    """Record an environment that may need Gymnasium-Robotics."""
    with robots_that_reset():
        if "/" not in name and name not in gymnasium.registry:
            pytest.skip("Gymnasium-Robotics is not installed")
        return record(name, directory, steps)


def replay_of(path, directory):
    """Write the replay of a recorded episode."""
    return mjrec.write_replay(mjrec.load_trajectory(path), directory / "page.html")


@pytest.fixture(scope="module")
def cheetah(tmp_path_factory):
    """Record an episode that its time limit truncates; the last state zooms in."""

    def change(env, step):
        if step == _STEPS:
            env.unwrapped.model.cam_fovy[0] = 30

    directory = tmp_path_factory.mktemp("cheetah")
    return record("HalfCheetah-v5", directory, _STEPS, change, max_episode_steps=_STEPS)


@pytest.fixture(scope="module")
def start():
    with chromium() as start:
        yield start


@contextlib.contextmanager
def page_opener(start):
    """Yield a function that opens pages; they must not fail or load anything else."""
    complaints = []
    # A page that stays open keeps rendering on the CPU.
    with contextlib.ExitStack() as browsers:

        def opened(address):
            # Pages of one browser would wait for each other.
            browser = start()
            browsers.callback(browser.close)
            page = browser.new_page(viewport={"width": 240, "height": 240})
            page.set_default_timeout(120_000)
            own = ("file:", "data:", "blob:", "http://127.0.0.1:")
            complaints.append(complaints_of(page, own))
            page.goto(address)
            page.wait_for_selector("html[data-replay=ready]", state="attached")
            return page

        yield opened
    assert [each for found in complaints for each in found] == []


@pytest.fixture
def pages(start):
    with page_opener(start) as opened:
        yield opened


@pytest.fixture(scope="module")
def page(cheetah, start, tmp_path_factory):
    """Open a replay of the cheetah at its seventh step."""
    file = replay_of(cheetah, tmp_path_factory.mktemp("page")).path
    with page_opener(start) as opened:
        yield opened(f"{file.as_uri()}#step=7&camera=track&speed=2")


def recorded_model(text, directory, *, steps):
    """Record a model without actions, and return its trajectory."""
    model, out = directory / "model.xml", directory / "run"
    model.write_text(text)
    arguments = ["--out", str(out), "--max-steps", str(steps), "--workers", "0"]
    assert main(["record", str(model), "--policy", "zero", *arguments]) == 0
    [path] = out.glob("*.h5")
    return mjrec.load_trajectory(path)


def data_at(trajectory, step):
    """Return MuJoCo's data of a recorded state."""
    data = mujoco.MjData(trajectory.model())
    trajectory.set_state(data, step)
    mujoco.mj_forward(data.model, data)
    return data


def numbers_in(text):
    """Return the reward and the return that the page shows."""
    return list(map(float, re.search(r"reward (.+?),.*return (\S+)", text).groups()))


def check_geoms(page, data):
    """Check that the page shows the geoms that MuJoCo draws, at the same poses."""
    page.wait_for_timeout(500)
    poses = {k: v for k, v in page.evaluate(_POSES).items() if k.startswith("/geom/")}
    scene = mujoco.MjvScene(data.model, maxgeom=10_000)
    view = (mujoco.MjvOption(), None, mujoco.MjvCamera(), mujoco.mjtCatBit.mjCAT_ALL)
    mujoco.mjv_updateScene(data.model, data, *view, scene)
    drawn = scene.geoms[: scene.ngeom]
    ids = {each.objid for each in drawn if each.objtype == mujoco.mjtObj.mjOBJ_GEOM}
    assert poses.keys() == {f"/geom/{number}" for number in ids}
    for name, (*position, w, x, y, z) in poses.items():
        geom = int(name.rpartition("/")[2])
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, np.array([w, x, y, z]))
        assert position == pytest.approx(data.geom_xpos[geom], abs=1e-5)
        assert matrix == pytest.approx(data.geom_xmat[geom], abs=1e-5)
    for skin in range(data.model.nskin):
        first, count = scene.skinvertadr[skin], scene.skinvertnum[skin]
        expected = np.reshape(scene.skinvert, (-1, 3))[first : first + count]
        shown = np.reshape(page.evaluate(_VERTICES, f"/skin/{skin}"), (-1, 3))
        assert shown == pytest.approx(expected, abs=1e-5)


# --- The page -----------------------------------------------------------------------


@pytest.mark.browser
@parametrize("name", _ENVIRONMENTS, default=2, part=pytest.mark.environments)
def test_geoms_skins_and_free_cameras_are_where_mujoco_has_them(name, pages, tmp_path):
    """Takes more than five seconds, as the browser draws without a GPU."""
    path = record_any(name, tmp_path / "run")
    file = replay_of(path, tmp_path).path
    page = pages(f"{file.as_uri()}#step={_STEPS}")
    check_geoms(page, data_at(mjrec.load_trajectory(path), _STEPS))
    shown = data_of(file.read_text())
    if shown["camera"] == "free":
        position, *_ = page.evaluate(_CAMERA)
        assert position == pytest.approx(shown["view"]["position"], abs=1e-4)


@pytest.mark.browser
def test_keys_move_through_the_states(page, cheetah):
    """The page starts at the state in its URL and shows rewards and ending."""
    trajectory = mjrec.load_trajectory(cheetah)
    check_geoms(page, data_at(trajectory, 7))
    page.keyboard.press("Home")
    assert "step 0 of 12" in page.inner_text("#replay-where")
    assert page.inner_text("#replay-ending") == ""
    page.keyboard.press(".")
    page.keyboard.press(".")
    where = page.inner_text("#replay-where")
    assert "step 2 of 12, 0.10 s" in where
    rewards = trajectory.rewards[:2]
    assert numbers_in(where) == pytest.approx([rewards[1], rewards.sum()], rel=1e-3)
    page.keyboard.press("End")
    assert page.inner_text("#replay-ending") == "Episode truncated"
    assert page.evaluate("location.hash") == "#step=12&camera=track&speed=2"
    check_geoms(page, data_at(trajectory, _STEPS))


@pytest.mark.browser
def test_a_model_camera_moves_and_zooms_as_in_videos(page, cheetah):
    """This camera has the same name as one of the page's own cameras."""
    trajectory = mjrec.load_trajectory(cheetah)
    page.keyboard.press("End")
    page.select_option("#replay-camera", label="track")
    for step, zoomed in ((_STEPS, 30), (_STEPS - 1, 45)):
        data = data_at(trajectory, step)
        position, fovy, _ = page.evaluate(_CAMERA)
        assert position == pytest.approx(data.cam_xpos[0], abs=1e-4)
        assert fovy == pytest.approx(zoomed)
        assert f"#step={step}&camera=0&" in page.evaluate("location.hash")
        page.keyboard.press(",")
    page.select_option("#replay-camera", label="tracking")


@pytest.mark.browser
def test_dragging_orbits_only_the_free_camera(page):
    page.set_viewport_size({"width": 240, "height": 400})
    canvas = page.locator("#root canvas").first.bounding_box()
    x, y = canvas["x"] + canvas["width"] / 2, canvas["y"] + canvas["height"] / 2
    for camera, turns in (("0", False), ("free", True)):
        page.select_option("#replay-camera", value=camera)
        before, *_ = page.evaluate(_CAMERA)
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 60, y, steps=4)
        page.mouse.up()
        page.evaluate(_AFTER_FRAMES, 10)
        after, *_ = page.evaluate(_CAMERA)
        assert (np.linalg.norm(np.subtract(after, before)) > 0.5) == turns
    # The height is the same.
    assert after[2] == pytest.approx(before[2], abs=0.01)
    page.select_option("#replay-camera", label="tracking")


@pytest.mark.browser
def test_bodies_cast_a_shadow_on_the_floor(page):
    """Parts of the gray floor are darker than without shadows."""
    page.set_viewport_size({"width": 240, "height": 400})
    page.keyboard.press("Home")
    page.select_option("#replay-camera", label="track")
    seen = []
    for casts in (False, True):
        page.evaluate(_CAST_SHADOWS, casts)
        page.evaluate(_AFTER_FRAMES, 10)
        image = page.locator("#root canvas").first.screenshot()
        seen.append(np.asarray(Image.open(io.BytesIO(image)).convert("RGB"), int))
    lit, shaded = seen
    is_floor = np.abs(lit[:, :, 0] - lit[:, :, 2]) < 40
    is_darker = (lit - shaded).min(axis=2) > 20
    assert (is_floor & is_darker).sum() > 20
    page.select_option("#replay-camera", label="tracking")


@pytest.mark.browser
def test_dragging_the_slider_to_its_middle_shows_the_middle_state(page, cheetah):
    """The tracking camera moves with the body."""
    trajectory = mjrec.load_trajectory(cheetah)
    page.select_option("#replay-camera", label="tracking")
    page.keyboard.press("Home")
    *_, before = page.evaluate(_CAMERA)
    place = page.locator("#replay-place").bounding_box()
    y = place["y"] + place["height"] / 2
    page.mouse.move(place["x"] + 8, y)
    page.mouse.down()
    page.mouse.move(place["x"] + place["width"] / 2, y, steps=4)
    page.mouse.up()
    assert page.evaluate(_STEP) == _STEPS / 2
    assert f"#step={_STEPS // 2}&" in page.evaluate("location.hash")
    data = data_at(trajectory, _STEPS // 2)
    check_geoms(page, data)
    moved = (
        data.body("torso").subtree_com
        - data_at(trajectory, 0).body("torso").subtree_com
    )
    *_, after = page.evaluate(_CAMERA)
    assert np.abs(moved).max() > 0.01
    assert np.subtract(after, before) == pytest.approx(moved, abs=1e-4)


@pytest.mark.browser
def test_a_higher_speed_takes_fewer_images(page):
    """At four times the speed, each image moves on by a step or more.

    Even on a slow machine, an image moves on by at most a quarter of a second.
    """
    images = {}
    for speed in ("4", "0.1"):
        page.keyboard.press("Home")
        page.select_option("#replay-speed", speed)
        assert page.evaluate("location.hash").endswith(f"&speed={speed}")
        images[speed] = page.evaluate(_IMAGES_UNTIL, 3)
    assert images["4"] <= 4 < 6 <= images["0.1"]


@pytest.mark.browser
def test_speed_keys_stop_at_the_slowest_and_the_fastest(page):
    for key, speed in (("]", "4"), ("[", "0.1")):
        for _ in range(8):
            page.keyboard.press(key)
        assert page.input_value("#replay-speed") == speed


@pytest.mark.browser
def test_the_curve_shows_the_step_under_the_cursor_and_a_click_goes_to_it(
    page, cheetah
):
    rewards = mjrec.load_trajectory(cheetah).rewards
    page.evaluate(_COLLECT_TEXT)
    curve = page.locator("#replay-curve")
    width = curve.bounding_box()["width"]
    place = {"x": width * 3 / _STEPS, "y": 5}
    curve.hover(position=place)
    text = page.evaluate("window.drawnText")[-1]
    assert "step 3 of 12" in text
    assert numbers_in(text) == pytest.approx([rewards[2], rewards[:3].sum()], rel=1e-3)
    curve.click(position=place)
    assert page.inner_text("#replay-where") == text


@pytest.mark.browser
def test_space_plays_and_pauses(page):
    """Playing begins at the reset and stops at the last state."""
    page.keyboard.press("End")
    page.evaluate("document.getElementById('replay-speed').value = '0.1'")
    page.keyboard.press(" ")
    assert page.inner_text("#replay-play") == "Pause"
    assert "step 12" not in page.inner_text("#replay-where")
    page.keyboard.press(" ")
    assert page.inner_text("#replay-play") == "Play"
    page.evaluate("document.getElementById('replay-speed').value = '4'")
    page.click("#replay-play")
    page.wait_for_function("() => document.getElementById('replay-ending').textContent")
    assert page.inner_text("#replay-play") == "Play"


@pytest.mark.browser
@pytest.mark.axe
def test_controls_and_help_are_accessible(page):
    page.keyboard.press("?")
    found = barriers_of(page, context=[["#replay"], ["#replay-keys"]])
    page.keyboard.press("Escape")
    assert found == []


@pytest.mark.browser
@pytest.mark.thorough
def test_the_live_view_follows_another_process_and_keeps_all_that_a_kill_leaves(
    pages, tmp_path
):
    with subprocess.Popen([sys.executable, "-c", _RUN, str(tmp_path)]) as run:
        try:
            wait_until(lambda: len(list(tmp_path.glob("*.log"))) > 0)
            with served(tmp_path) as view:
                page = pages(view.url)
                page.wait_for_function(_STEP_SHOWN, arg=1)
                page.wait_for_function(_STEP_SHOWN, arg=page.evaluate(_STEP) + 1)
                run.kill()
                run.wait()
                [path] = recorded_episodes(tmp_path)
                last = len(mjrec.load_trajectory(path))
                page.wait_for_function(_STEP_SHOWN, arg=last)
        finally:
            run.kill()


@pytest.mark.browser
def test_the_live_view_shows_the_chosen_episode(pages, tmp_path):
    """It does not jump back, even if the page reloads for other geom sizes.

    The page also shows the returns, and viewing leaves the files as they were.
    """
    env = gymnasium.make("Hopper-v5", max_episode_steps=2)
    returns = []
    with mjrec.Monitor(env, tmp_path, lambda _: True, workers=0) as run:
        for radius in (0.05, 0.2):
            run.unwrapped.model.geom_size[2, 0] = radius
            run.reset(seed=0)
            returns.append(sum(run.step(np.full(3, 4 * radius))[1] for _ in range(2)))
    before = files_in(tmp_path)
    with served(tmp_path) as view:
        page = pages(view.url)
        for number, width in ((1, 0.4), (0, 0.1)):
            button = page.locator(f"#live-episodes button:text('{number}: 2')")
            # A click would wait until the list is not replaced.
            button.dispatch_event("click")
            title = f"Hopper-v5, episode {number}"
            page.wait_for_function("(title) => document.title === title", arg=title)
            page.wait_for_selector("html[data-replay=ready]", state="attached")
            page.wait_for_selector("#live-episodes [aria-pressed=true]")
            assert f"{title}: recorded" in page.inner_text("#replay")
            shown = np.reshape(page.evaluate(_VERTICES, "/geom/2"), (-1, 3))
            assert np.ptp(shown, axis=0).min() == pytest.approx(width, rel=0.1)
            assert page.inner_text("#live-count") == "Complete episodes: 2"
        curve = page.locator("#live-returns")
        low, high = (f"{each:.4g}" for each in sorted(returns))
        assert low != high
        label = f"Returns of 2 episodes, from {low} to {high}"
        assert curve.get_attribute("aria-label") == label
        heights = {x > 0.5: y for x, y in curve.evaluate(_DOTS)}
        assert len(heights) == 2
        assert (heights[False] > heights[True]) == (returns[0] < returns[1])
    assert files_in(tmp_path) == before


@pytest.mark.browser
@pytest.mark.thorough
def test_tendons_and_cloth_have_the_shapes_that_mujoco_computes(pages, tmp_path):
    trajectory = recorded_model(_SOFT, tmp_path, steps=8)
    file = tmp_path / "replay.html"
    assert mjrec.write_replay(trajectory, file).notes == (OWN_LIGHTS,)
    page = pages(f"{file.as_uri()}#step=8")
    # The page draws the cloth with vertices at zero until its motion is loaded.
    page.wait_for_function(f"({_VERTICES})('/flex/0')?.some(Boolean)", polling=50)
    data = data_at(trajectory, 8)
    shown = np.reshape(page.evaluate(_VERTICES, "/flex/0"), (-1, 3))
    assert shown == pytest.approx(data.flexvert_xpos, abs=1e-5)
    normals = np.reshape(page.evaluate(_NORMALS, "/flex/0"), (-1, 3))
    assert normals == pytest.approx(np.tile([0, 0, 1], (16, 1)), abs=1e-5)
    segments = [n for n in page.evaluate(_POSES) if n.startswith("/tendon/")]
    sizes = np.array(page.evaluate(_SIZES, segments))
    is_shown = sizes[:, 2] > 1e-6
    # The tendon has more segments in other states.
    assert 2 <= is_shown.sum() < len(segments)
    assert sizes[is_shown, 0] == pytest.approx(0.01)
    assert sizes.max() < 1


# --- The file -----------------------------------------------------------------------


@parametrize(
    ("name", "steps", "largest"),
    [
        ("Hopper-v5", _STEPS, 2_000_000),
        ("dm_control/cartpole-balance", _STEPS, 2_000_000),
        ("Humanoid-v5", 999, 5_000_000),
    ],
    default=2,
)
def test_a_replay_of_all_states_is_small(name, steps, largest, tmp_path):
    options = {"terminate_when_unhealthy": False} if steps == 999 else {}
    made = replay_of(record(name, tmp_path / "run", steps, **options), tmp_path)
    assert made.states == steps + 1
    assert 500_000 < made.size == made.path.stat().st_size < largest


def test_the_command_writes_the_episode_of_a_number(cheetah, tmp_path, capsys):
    page = tmp_path / "page.html"
    options = ["--episode", "0", "--max-fps", "5", "--out", str(page)]
    assert main(["replay", str(cheetah.parent), *options]) == 0
    # Every fourth of 13 states at 20 Hz.
    assert capsys.readouterr().out.startswith(f"{page}: 4 states, ")
    assert main(["replay", str(cheetah.parent), "--episode", "3"]) == 1
    assert "Available: 0." in capsys.readouterr().err


def test_the_command_writes_the_episode_of_a_file(cheetah, tmp_path, capsys):
    """A number is refused, as a file has one episode."""
    page = tmp_path / "page.html"
    command = ["replay", str(cheetah), "--out", str(page)]
    assert main([*command, "--episode", "0"]) == 1
    assert "single episode. Omit --episode" in capsys.readouterr().err
    assert not page.exists()
    assert main(command) == 0
    assert capsys.readouterr().out.startswith(f"{page}: 13 states, ")


def test_states_that_are_not_finite_are_left_out(cheetah, tmp_path):
    """Without any finite state, nothing is written."""
    trajectory = mjrec.load_trajectory(cheetah)
    trajectory.states[-1] = np.nan
    made = mjrec.write_replay(trajectory, tmp_path / "page.html")
    assert made.states == _STEPS
    note = "States left out because they are not finite: 1 of 13."
    assert made.notes == (OWN_LIGHTS, note)
    trajectory.states[:] = np.nan
    with pytest.raises(UnreadableFile, match="none of the states to show is finite"):
        mjrec.write_replay(trajectory, tmp_path / "page.html")


def test_an_environment_name_cannot_run_code(cheetah, tmp_path):
    trajectory = mjrec.load_trajectory(cheetah)
    trajectory.facts = {**trajectory.facts, "env_id": "</script><script>alert(1)"}
    made = mjrec.write_replay(trajectory, tmp_path / "page.html")
    assert "<script>alert" not in made.path.read_text()


def test_geoms_change_color_appear_and_vanish_as_in_the_model(tmp_path):
    """A geom that appears later is hidden at first."""

    def change(env, step):
        env.unwrapped.model.geom_rgba[2] = (1, 0, 0, step > 2)
        if step == 3:
            env.unwrapped.model.geom_rgba[3] = (0, 1, 0, 1)
            env.unwrapped.model.geom_rgba[4, 3] = 0

    trajectory = mjrec.load_trajectory(record("Hopper-v5", tmp_path, 4, change))
    # Without the reset's state, geom 2 is invisible at first.
    trajectory.states[0] = np.nan
    made = mjrec.write_replay(trajectory, tmp_path / "page.html")
    note = "States left out because they are not finite: 1 of 5."
    assert made.notes == (OWN_LIGHTS, note)
    data = data_of(made.path.read_text())
    assert data["rgba"]["/geom/2"][3] == 0
    changes = {name: (at, rgba) for at, name, rgba in data["chunk"]["colours"]}
    assert len(changes) == len(data["chunk"]["colours"]) == 3
    assert changes["/geom/2"] == (2, [1, 0, 0, 1])
    assert changes["/geom/3"] == (2, [0, 1, 0, 1])
    assert (changes["/geom/4"][0], changes["/geom/4"][1][3]) == (2, 0)


def test_the_view_follows_the_first_tree_with_a_joint(tmp_path):
    """A mocap body before it does not count."""
    trajectory = recorded_model(_PICKER, tmp_path, steps=2)
    page = mjrec.write_replay(trajectory, tmp_path / "page.html").path
    centre = data_at(trajectory, 0).body("arm").subtree_com
    assert data_of(page.read_text())["start"] == pytest.approx(centre)


def check_note(made, note, caplog):
    """Check that the result, the log and the page have a note, and the constant one."""
    assert made.notes == (OWN_LIGHTS, note)
    for each in made.notes:
        assert each in caplog.text
        assert f"<p>{html.escape(each)}</p>" in made.path.read_text()


@pytest.mark.parametrize(
    ("field", "kind"),
    [("geom_size", "Sizes and meshes"), ("mat_texrepeat", "Textures")],
)
def test_a_note_names_changes_that_are_not_shown(field, kind, tmp_path, caplog):
    def change(env, step):
        if step == 2:
            getattr(env.unwrapped.model, field)[:] *= 2

    caplog.set_level(logging.INFO)
    made = replay_of(record("Hopper-v5", tmp_path, 4, change), tmp_path)
    check_note(made, f"{kind} change during the episode but not on this page.", caplog)


def test_a_note_says_that_ropes_are_not_shown(tmp_path, caplog):
    trajectory = recorded_model(_ROPE, tmp_path, steps=2)
    caplog.set_level(logging.INFO)
    made = mjrec.write_replay(trajectory, tmp_path / "page.html")
    check_note(made, "One-dimensional flexible bodies are not shown.", caplog)


def test_a_note_says_that_videos_show_objects_elsewhere(tmp_path):
    """For a video, the environment puts a hand's goal, which falls, in its place."""
    path = record_any("HandManipulateBlock-v1", tmp_path / "run", 1)
    _, note = replay_of(path, tmp_path).notes
    assert note.startswith("The videos show some objects in other places")


def test_sides_of_a_cube_have_the_whole_texture_and_smooth_normals(tmp_path):
    """An image for all sides is not cut into six."""
    Image.new("RGB", (8, 8), "red").save(tmp_path / "side.png")
    path = tmp_path / "box.xml"
    path.write_text(_BOX)
    model = mujoco.MjModel.from_xml_path(str(path))
    kinds = (mujoco.mjtObj.mjOBJ_GEOM, 0, mujoco.mjtGeom.mjGEOM_BOX)
    mesh = mesh_of(model, Shape("/geom/0", *map(int, kinds), (1.0, 1.0, 1.0, 1.0)))
    assert b"NORMAL" in mesh.export(file_type="glb")
    top = mesh.vertex_normals[:, 2] > 0.9
    assert np.ptp(mesh.visual.uv[top], axis=0) == pytest.approx([1, 1])
