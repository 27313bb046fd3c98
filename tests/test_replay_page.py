# SPDX-License-Identifier: Apache-2.0
"""Replays: files that show recorded episodes in 3D, opened in headless Chromium."""

import io
import json
import subprocess
import sys
import threading

import gymnasium
import mujoco
import numpy as np
import pytest
from browsers import barriers_of, chromium, complaints_of
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
from mjrec.viewing.live import LiveView
from mjrec.viewing.motion import Shape

_STEPS = 12
# Meshes, skins, height fields, tendons, mocap bodies; hundreds of geoms.
_ENVIRONMENTS = (
    *("FetchReach-v4", "dm_control/ball_in_cup-catch"),
    *("Humanoid-v5", "Ant-v5", "Pusher-v5", "FetchPickAndPlace-v4"),
    *("AdroitHandDoor-v1", "HandManipulateBlock-v1"),
    *("dm_control/dog-run", "dm_control/quadruped-escape"),
    "dm_control/fish-swim",
)

# All shapes that are not geoms of one size: tendons around a cylinder, a cloth.
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

# A hand that is moved from outside comes first, as in Fetch.
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

# Where nodes of the scene are, in the frame of the model.
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
# What the page writes on its curve from now on.
_NOTE_TEXT = """() => {
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
  return [viewer.camera.position.clone().applyQuaternion(inverse).toArray(),
    viewer.camera.fov];
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
# Plays until a step is shown, and counts the images until then.
_IMAGES_UNTIL = f"""async (step) => {{
  document.getElementById("replay-play").click();
  let images = 0;
  for (; {_STEP} < step; images++) await new Promise(requestAnimationFrame);
  return images;
}}"""
_STEP_SHOWN = f"(step) => {_STEP} >= step"

# An episode that goes on until the process is killed.
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
    """Record an episode without drawing it, and return its trajectory's path."""
    if name.startswith("dm_control/"):
        suite = pytest.importorskip("dm_control.suite")
        task = name.removeprefix("dm_control/").split("-")
        env = suite.load(*task, task_kwargs={"random": 0})
        draw, begin, said = env.action_spec().generate_value, {}, {"env_id": name}
    else:
        env = gymnasium.make(name, **options)
        env.action_space.seed(0)
        draw, begin, said = env.action_space.sample, {"seed": 0}, {}
    with mjrec.Monitor(env, directory, lambda _: True, workers=0, **said) as monitor:
        monitor.reset(**begin)
        for step in range(1, steps + 1):
            change(env, step)
            monitor.step(draw())
    [path] = directory.glob("*.h5")
    return path


@pytest.fixture(scope="module")
def cheetah(tmp_path_factory):
    """Record a short episode that is cut by its time limit, its last state enlarged."""

    def change(env, step):
        if step == _STEPS:
            env.unwrapped.model.cam_fovy[0] = 30

    directory = tmp_path_factory.mktemp("cheetah")
    return record("HalfCheetah-v5", directory, _STEPS, change, max_episode_steps=_STEPS)


@pytest.fixture(scope="module")
def pages():
    """Yield what opens a page that must not fail, nor ask for anything but itself."""
    complaints = []
    with chromium() as start:

        def opened(address):
            # One for each page: they draw without a GPU, and would wait for each other.
            page = start().new_page(viewport={"width": 240, "height": 240})
            page.set_default_timeout(120_000)
            own = ("file:", "data:", "blob:", "http://127.0.0.1:")
            complaints.append(complaints_of(page, own))
            page.goto(address)
            page.wait_for_selector("html[data-replay=ready]", state="attached")
            return page

        yield opened
    assert [each for said in complaints for each in said] == []


@pytest.fixture(scope="module")
def page(cheetah, pages, tmp_path_factory):
    """Open a replay of the cheetah at its seventh step."""
    file = tmp_path_factory.mktemp("page") / "replay.html"
    mjrec.write_replay(mjrec.load_trajectory(cheetah), file)
    return pages(f"{file.as_uri()}#step=7&camera=track&speed=2")


def recorded_model(text, directory, *, steps):
    """Record a model without actions, and return its trajectory."""
    model, out = directory / "model.xml", directory / "run"
    model.write_text(text)
    arguments = ["--out", str(out), "--max-steps", str(steps), "--workers", "0"]
    assert main(["record", str(model), "--policy", "zero", *arguments]) == 0
    [path] = out.glob("*.h5")
    return mjrec.load_trajectory(path)


def data_at(trajectory, step):
    """Return what MuJoCo computes from a recorded state."""
    data = mujoco.MjData(trajectory.model())
    trajectory.set_state(data, step)
    mujoco.mj_forward(data.model, data)
    return data


def data_in(page):
    """Return what a page's script reads."""
    text = page.read_text().split('id="replay-data">')[1].split("</script>")[0]
    return json.loads(text)


def check_geoms(page, data):
    """Check that the page has the geoms that MuJoCo draws, where MuJoCo has them."""
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
def test_all_kinds_of_scenes_stand_where_mujoco_has_them(name, pages, tmp_path):
    """So do meshes, skins, height fields, and bodies that the simulation moves.

    A browser draws each without a GPU, which takes more than five seconds.
    """
    with robots_that_reset():
        if "/" not in name and name not in gymnasium.registry:
            pytest.skip("Gymnasium-Robotics is not installed")
        path = record(name, tmp_path / "run")
    trajectory = mjrec.load_trajectory(path)
    mjrec.write_replay(trajectory, tmp_path / "page.html")
    page = pages(f"{(tmp_path / 'page.html').as_uri()}#step={_STEPS}")
    check_geoms(page, data_at(trajectory, _STEPS))
    shown = data_in(tmp_path / "page.html")
    if shown["camera"] == "free":
        # It stands where the environment has put it, as in the videos.
        position, _ = page.evaluate(_CAMERA)
        assert position == pytest.approx(shown["view"]["position"], abs=1e-4)


@pytest.mark.browser
def test_keys_go_through_the_states(page, cheetah):
    """Steps, their rewards and the end are shown; the address keeps the place."""
    trajectory = mjrec.load_trajectory(cheetah)
    # It begins at the state that its address names.
    check_geoms(page, data_at(trajectory, 7))
    page.keyboard.press("Home")
    assert "step 0 of 12" in page.inner_text("#replay-where")
    assert page.inner_text("#replay-ending") == ""
    page.keyboard.press(".")
    page.keyboard.press(".")
    where = page.inner_text("#replay-where")
    assert "step 2 of 12, 0.10 s" in where
    reward = float(where.split("reward ")[1].split(",")[0])
    assert reward == pytest.approx(trajectory.rewards[1], rel=1e-3)
    returned = float(where.split("return ")[1])
    assert returned == pytest.approx(trajectory.rewards[:2].sum(), rel=1e-3)
    page.keyboard.press("End")
    assert page.inner_text("#replay-ending") == "Episode truncated"
    assert page.evaluate("location.hash") == "#step=12&camera=track&speed=2"
    check_geoms(page, data_at(trajectory, _STEPS))


@pytest.mark.browser
def test_a_camera_of_the_model_is_kept_from_step_to_step(page, cheetah):
    """It moves and zooms as in the videos, also if it is named like one of the page."""
    trajectory = mjrec.load_trajectory(cheetah)
    page.keyboard.press("End")
    page.select_option("#replay-camera", label="track")
    for step, zoomed in ((_STEPS, 30), (_STEPS - 1, 45)):
        data = data_at(trajectory, step)
        position, fovy = page.evaluate(_CAMERA)
        assert position == pytest.approx(data.cam_xpos[0], abs=1e-4)
        assert fovy == pytest.approx(zoomed)
        assert f"#step={step}&camera=0&" in page.evaluate("location.hash")
        page.keyboard.press(",")
    page.select_option("#replay-camera", label="tracking")


@pytest.mark.browser
def test_dragging_turns_the_free_camera_only(page):
    """It turns around what it looks at; a camera of the model stays in its place."""
    page.set_viewport_size({"width": 240, "height": 400})
    canvas = page.locator("#root canvas").first.bounding_box()
    x, y = canvas["x"] + canvas["width"] / 2, canvas["y"] + canvas["height"] / 2
    for camera, turns in (("0", False), ("free", True)):
        page.select_option("#replay-camera", value=camera)
        before, _ = page.evaluate(_CAMERA)
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 60, y, steps=4)
        page.mouse.up()
        page.evaluate(_AFTER_FRAMES, 10)
        after, _ = page.evaluate(_CAMERA)
        assert (np.linalg.norm(np.subtract(after, before)) > 0.5) == turns
    # It went around, neither up nor nearer.
    assert after[2] == pytest.approx(before[2], abs=0.01)
    page.select_option("#replay-camera", label="tracking")


@pytest.mark.browser
def test_bodies_cast_a_shadow_on_the_floor(page):
    """Places of the gray floor are darker than without the shadows of the bodies."""
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
def test_the_slider_scrubs(page, cheetah):
    """Dragging it to its middle shows the state in the middle."""
    page.keyboard.press("Home")
    place = page.locator("#replay-place").bounding_box()
    y = place["y"] + place["height"] / 2
    page.mouse.move(place["x"] + 8, y)
    page.mouse.down()
    page.mouse.move(place["x"] + place["width"] / 2, y, steps=4)
    page.mouse.up()
    assert page.evaluate(_STEP) == _STEPS / 2
    assert f"#step={_STEPS // 2}&" in page.evaluate("location.hash")
    check_geoms(page, data_at(mjrec.load_trajectory(cheetah), _STEPS // 2))


@pytest.mark.browser
def test_the_chosen_speed_plays_faster(page):
    """At four times the speed, each image is at least a step on; at a tenth, it isn't.

    However slow the machine is, the page goes on by at most a quarter of a second
    between two images.
    """
    images = {}
    for speed in ("4", "0.1"):
        page.keyboard.press("Home")
        page.select_option("#replay-speed", speed)
        assert page.evaluate("location.hash").endswith(f"&speed={speed}")
        images[speed] = page.evaluate(_IMAGES_UNTIL, 3)
    assert images["4"] <= 4 < 6 <= images["0.1"]


@pytest.mark.browser
def test_speeds_end_at_the_slowest_and_the_fastest(page):
    """Keys beyond the ends change nothing."""
    for key, speed in (("]", "4"), ("[", "0.1")):
        for _ in range(8):
            page.keyboard.press(key)
        assert page.input_value("#replay-speed") == speed


@pytest.mark.browser
def test_the_curve_tells_the_step_under_the_cursor(page, cheetah):
    """Pointing shows a step's reward and return, a click goes to it."""
    rewards = mjrec.load_trajectory(cheetah).rewards
    page.evaluate(_NOTE_TEXT)
    curve = page.locator("#replay-curve")
    width = curve.bounding_box()["width"]
    place = {"x": width * 3 / _STEPS, "y": 5}
    curve.hover(position=place)
    told = page.evaluate("window.drawnText")[-1]
    assert "step 3 of 12" in told
    assert float(told.split("reward ")[1].split(",")[0]) == pytest.approx(
        rewards[2], rel=1e-3
    )
    assert float(told.split("return ")[1]) == pytest.approx(rewards[:3].sum(), rel=1e-3)
    curve.click(position=place)
    assert page.inner_text("#replay-where") == told


@pytest.mark.browser
def test_it_plays_and_pauses(page):
    """Space plays from the reset and pauses; playing stops at the last state."""
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
def test_nothing_keeps_people_out_of_a_replay(page):
    """Axe finds nothing serious in the controls, with the keys shown."""
    page.keyboard.press("?")
    found = barriers_of(page, context=[["#replay"], ["#replay-keys"]])
    page.keyboard.press("Escape")
    assert found == []


@pytest.mark.browser
@pytest.mark.thorough
def test_the_live_view_follows_a_run_until_it_is_killed(pages, tmp_path):
    """A page shows the newest states of another process, and all that a kill leaves."""
    run = subprocess.Popen([sys.executable, "-c", _RUN, str(tmp_path)])
    thread = None
    try:
        wait_until(lambda: len(list(tmp_path.glob("*.log"))) > 0)
        view = LiveView(tmp_path)
        thread = threading.Thread(target=view.serve)
        thread.start()
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
        run.wait()
        if thread is not None:
            view.close()
            thread.join()


@pytest.mark.browser
def test_a_chosen_episode_is_shown_with_its_shapes_and_its_name(pages, tmp_path):
    """Also if the page is loaded again for other shapes: it does not jump back."""
    env = gymnasium.make("Hopper-v5", max_episode_steps=2)
    with mjrec.Monitor(env, tmp_path, lambda _: True, workers=0) as run:
        for radius in (0.05, 0.2):
            run.unwrapped.model.geom_size[2, 0] = radius
            run.reset(seed=0)
            run.step(np.zeros(3))
            run.step(np.zeros(3))
    with LiveView(tmp_path) as view:
        thread = threading.Thread(target=view.serve)
        thread.start()
        try:
            page = pages(view.url)
            for number, width in ((1, 0.4), (0, 0.1)):
                button = page.locator(f"#live-episodes button:text('{number}: 2')")
                # A click would wait for a list that is not replaced meanwhile.
                button.dispatch_event("click")
                title = f"Hopper-v5, episode {number}"
                page.wait_for_function("(said) => document.title === said", arg=title)
                page.wait_for_selector("html[data-replay=ready]", state="attached")
                page.wait_for_selector("#live-episodes [aria-pressed=true]")
                assert f"{title}: recorded" in page.inner_text("#replay")
                shown = np.reshape(page.evaluate(_VERTICES, "/geom/2"), (-1, 3))
                assert np.ptp(shown, axis=0).min() == pytest.approx(width, rel=0.1)
                assert page.inner_text("#live-count") == "Complete episodes: 2"
        finally:
            view.close()
            thread.join()


@pytest.mark.browser
@pytest.mark.thorough
def test_tendons_and_cloth_move(pages, tmp_path):
    """What changes its shape has the vertices and the segments that MuJoCo computes."""
    trajectory = recorded_model(_SOFT, tmp_path, steps=8)
    file = tmp_path / "replay.html"
    assert mjrec.write_replay(trajectory, file).notes == ()
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
    is_there = sizes[:, 2] > 1e-6
    # The tendon has fewer segments here than in another state.
    assert 2 <= is_there.sum() < len(segments)
    assert sizes[is_there, 0] == pytest.approx(0.01)
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
def test_replays_are_small(name, steps, largest, tmp_path):
    """A replay has all recorded states; a thousand of Humanoid's take at most 5 MB."""
    options = {"terminate_when_unhealthy": False} if steps == 999 else {}
    path = record(name, tmp_path / "run", steps, **options)
    made = mjrec.write_replay(mjrec.load_trajectory(path), tmp_path / "page.html")
    assert made.states == steps + 1
    assert 500_000 < made.size == made.path.stat().st_size < largest


def test_the_command_writes_an_episode_of_a_directory(cheetah, tmp_path, capsys):
    """`mjrec replay DIR --episode N` takes an episode by its number, at a rate."""
    page = tmp_path / "page.html"
    options = ["--episode", "0", "--max-fps", "5", "--out", str(page)]
    assert main(["replay", str(cheetah.parent), *options]) == 0
    # Every fourth of 13 states, at twenty a second.
    assert capsys.readouterr().out.startswith(f"{page}: 4 states, ")
    assert main(["replay", str(cheetah.parent), "--episode", "3"]) == 1
    assert "Available: 0." in capsys.readouterr().err


def test_what_cannot_be_shown_is_left_out(cheetah, tmp_path):
    """A state that is no numbers, as after a reset; a name that is code is text."""
    trajectory = mjrec.load_trajectory(cheetah)
    trajectory.facts = {**trajectory.facts, "env_id": "</script><script>alert(1)"}
    trajectory.states[-1] = np.nan
    made = mjrec.write_replay(trajectory, tmp_path / "page.html")
    assert made.states == _STEPS
    assert made.notes == ("States left out because they are not finite: 1 of 13.",)
    assert "<script>alert" not in made.path.read_text()


def test_colours_change_when_the_model_does(tmp_path):
    """A geom has the colour that it had in each state; one that vanishes is hidden."""

    def change(env, step):
        if step == 3:
            env.unwrapped.model.geom_rgba[2] = (1, 0, 0, 1)
            env.unwrapped.model.geom_rgba[3, 3] = 0

    path = record("Hopper-v5", tmp_path, 4, change)
    page = tmp_path / "page.html"
    mjrec.write_replay(mjrec.load_trajectory(path), page)
    colours = {each[1]: each for each in data_in(page)["chunk"]["colours"]}
    assert colours["/geom/2"] == [3, "/geom/2", [1, 0, 0, 1]]
    assert colours["/geom/3"][0] == 3
    assert colours["/geom/3"][2][3] == 0


def test_the_view_follows_what_joints_move(tmp_path):
    """It is the first tree with a joint, not a mocap body that comes before it."""
    trajectory = recorded_model(_PICKER, tmp_path, steps=2)
    page = mjrec.write_replay(trajectory, tmp_path / "page.html").path
    centre = data_at(trajectory, 0).body("arm").subtree_com
    assert data_in(page)["start"] == pytest.approx(centre)


def test_what_appears_later_is_there_hidden(tmp_path):
    """A geom that the first state does not show is part of the page."""

    def change(env, step):
        env.unwrapped.model.geom_rgba[2] = (1, 0, 0, step > 2)

    trajectory = mjrec.load_trajectory(record("Hopper-v5", tmp_path, 4, change))
    trajectory.states[0] = np.nan
    made = mjrec.write_replay(trajectory, tmp_path / "page.html")
    assert made.notes == ("States left out because they are not finite: 1 of 5.",)
    data = data_in(tmp_path / "page.html")
    assert data["rgba"]["/geom/2"][3] == 0
    assert data["chunk"]["colours"] == [[2, "/geom/2", [1, 0, 0, 1]]]


@pytest.mark.parametrize(
    ("field", "kind"),
    [("geom_size", "Sizes and meshes"), ("mat_texrepeat", "Textures")],
)
def test_changes_that_are_not_shown_are_named(field, kind, tmp_path, caplog):
    """Shapes and their images stay as at the reset; the page and the log say so."""

    def change(env, step):
        if step == 2:
            getattr(env.unwrapped.model, field)[:] *= 2

    path = record("Hopper-v5", tmp_path, 4, change)
    made = mjrec.write_replay(mjrec.load_trajectory(path), tmp_path / "page.html")
    assert made.notes == (f"{kind} change during the episode but not on this page.",)
    assert made.notes[0] in caplog.text
    assert f"<p>{made.notes[0]}</p>" in made.path.read_text()


def test_sides_have_the_whole_texture_and_normals(tmp_path):
    """One image for all sides is not cut into six; round shapes look smooth."""
    Image.new("RGB", (8, 8), "red").save(tmp_path / "side.png")
    path = tmp_path / "box.xml"
    path.write_text(_BOX)
    model = mujoco.MjModel.from_xml_path(str(path))
    kinds = (mujoco.mjtObj.mjOBJ_GEOM, 0, mujoco.mjtGeom.mjGEOM_BOX)
    mesh = mesh_of(model, Shape("/geom/0", *map(int, kinds), (1.0, 1.0, 1.0, 1.0)))
    assert b"NORMAL" in mesh.export(file_type="glb")
    top = mesh.vertex_normals[:, 2] > 0.9
    assert np.ptp(mesh.visual.uv[top], axis=0) == pytest.approx([1, 1])


def test_what_only_the_videos_show_elsewhere_is_named(tmp_path):
    """A hand's goal, which falls in the states, is put in its place to be drawn."""
    with robots_that_reset():
        if "HandManipulateBlock-v1" not in gymnasium.registry:
            pytest.skip("Gymnasium-Robotics is not installed")
        path = record("HandManipulateBlock-v1", tmp_path / "run", 1)
    made = mjrec.write_replay(mjrec.load_trajectory(path), tmp_path / "page.html")
    [note] = made.notes
    assert note.startswith("The videos show some objects in other places")


def test_an_episode_without_finite_states_is_refused(cheetah, tmp_path):
    """The error names the file and says why there is nothing to show."""
    trajectory = mjrec.load_trajectory(cheetah)
    trajectory.states[:] = np.nan
    with pytest.raises(UnreadableFile, match="none of the states to show is finite"):
        mjrec.write_replay(trajectory, tmp_path / "page.html")


def test_the_page_says_what_it_does_not_show(tmp_path, caplog):
    """A rope has no surface; the result, the log and the page say so."""
    trajectory = recorded_model(_ROPE, tmp_path, steps=2)
    made = mjrec.write_replay(trajectory, tmp_path / "page.html")
    assert made.notes == ("One-dimensional flexible bodies are not shown.",)
    assert made.notes[0] in caplog.text
    assert f"<p>{made.notes[0]}</p>" in made.path.read_text()
