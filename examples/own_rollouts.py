"""Draw your own states: two rollouts from `mujoco.rollout`, side by side."""

import mjrec

mjrec.use_gl()  # before MuJoCo is imported

import mujoco  # noqa: E402
import mujoco.rollout  # noqa: E402
import numpy as np  # noqa: E402

MODEL = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <light pos="0 0 3"/>
    <geom type="plane" size="2 2 .1" rgba=".8 .8 .8 1"/>
    <camera name="side" pos="0 -2.2 .9" xyaxes="1 0 0 0 .3 1"/>
    <body pos="0 0 .8">
      <joint name="swing" type="hinge" axis="0 1 0" damping=".02"/>
      <geom type="capsule" fromto="0 0 0 .5 0 0" size=".05" rgba=".2 .4 .8 1"/>
    </body>
  </worldbody>
  <actuator><motor joint="swing" gear="2"/></actuator>
</mujoco>
"""
SPEC = mujoco.mjtState.mjSTATE_FULLPHYSICS


def main() -> None:
    model = mujoco.MjModel.from_xml_string(MODEL)
    data = mujoco.MjData(model)
    initial = np.zeros((2, mujoco.mj_stateSize(model, SPEC)))
    control = np.stack([np.zeros((60, 1)), np.ones((60, 1))])
    states, _ = mujoco.rollout.rollout(model, data, initial, control)
    videos = [
        list(mjrec.render_states(model, rows, SPEC, height=120, width=160, camera=0))
        for rows in states
    ]
    side_by_side = [
        np.concatenate(frames, axis=1) for frames in zip(*videos, strict=True)
    ]
    mjrec.save_video(side_by_side, "recordings/own_rollouts", fps=100)
    print(len(side_by_side), "frames of", states.shape[0], "rollouts")


if __name__ == "__main__":
    main()
