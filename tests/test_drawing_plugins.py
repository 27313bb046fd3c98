# SPDX-License-Identifier: Apache-2.0
"""Plugins that draw are known before they do."""

from __future__ import annotations

import mujoco
import pytest
from touch_grid import TOUCH_GRID

from mjrec.simulation import drawing_plugins
from mjrec.simulation.drawing_plugins import drawing_plugin

CABLE = """
<mujoco>
  <extension><plugin plugin="mujoco.elasticity.cable"/></extension>
  <worldbody>
    <composite type="cable" curve="s" count="5 1 1" size="1" initial="none">
      <plugin plugin="mujoco.elasticity.cable">
        <config key="twist" value="1e7"/><config key="bend" value="4e6"/>{}
      </plugin>
      <geom type="capsule" size=".005"/>
    </composite>
  </worldbody>
</mujoco>
"""

PID = """
<mujoco>
  <extension><plugin plugin="mujoco.pid"/></extension>
  <worldbody><body><joint name="j"/><geom size=".1"/></body></worldbody>
  <actuator>
    <plugin joint="j" plugin="mujoco.pid"><config key="kp" value="4"/></plugin>
  </actuator>
</mujoco>
"""


def compiled(xml: str) -> mujoco.MjModel:
    try:
        return mujoco.MjModel.from_xml_string(xml)
    except ValueError as error:
        # mujoco 4 has no cable.
        pytest.skip(f"not in this version: {error}")


def test_a_touch_grid_draws_before_anything_touches_it() -> None:
    """Its cells appear with the first contact, so that no picture tells."""
    assert drawing_plugin(compiled(TOUCH_GRID)) == "mujoco.sensor.touch_grid"


@pytest.mark.parametrize(
    ("vmax", "draws"),
    [
        ("", False),
        ('<config key="vmax" value="0"/>', False),
        ('<config key="vmax" value=".05"/>', True),
    ],
)
def test_a_cable_draws_if_it_is_told_to(vmax: str, draws: bool) -> None:
    """With the attribute it paints its geoms by their strain."""
    found = drawing_plugin(compiled(CABLE.format(vmax)))
    assert found == ("mujoco.elasticity.cable" if draws else None)


def test_most_plugins_do_not_draw() -> None:
    """A controller, for one; nor does a model without any."""
    assert drawing_plugin(compiled(PID)) is None
    assert drawing_plugin(compiled("<mujoco/>")) is None


def test_what_cannot_be_looked_at_counts_as_drawing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Where MuJoCo's register cannot be read nothing is believed."""
    monkeypatch.setattr(drawing_plugins, "_library", lambda: None)
    assert "cannot be looked at" in (drawing_plugin(compiled(PID)) or "")
