# SPDX-License-Identifier: Apache-2.0
"""A model with a plugin that draws: a ball near a floor that feels what touches it."""

TOUCH_GRID = """
<mujoco>
  <extension><plugin plugin="mujoco.sensor.touch_grid"/></extension>
  <worldbody>
    <geom type="plane" size="1 1 1"/><light pos="0 0 3"/>
    <body pos="0 0 .09"><freejoint/><geom size=".1"/><site name="s"/></body>
  </worldbody>
  <sensor>
    <plugin plugin="mujoco.sensor.touch_grid" objtype="site" objname="s">
      <config key="size" value="7 7"/><config key="fov" value="45 45"/>
      <config key="gamma" value="0"/><config key="nchannel" value="1"/>
    </plugin>
  </sensor>
</mujoco>
"""
