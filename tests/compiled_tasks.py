# SPDX-License-Identifier: Apache-2.0
"""A dm_control task whose model changes in each episode."""


def growing():
    """Return a composer task that compiles a new model at each reset."""
    from dm_control import composer

    class Growing(composer.Task):
        def __init__(self):
            self.root_entity = composer.Arena()
            world = self.root_entity.mjcf_model.worldbody
            world.add("light", pos=(0, 0, 3))
            world.add("camera", pos=(0, -3, 0.5), xyaxes=(1, 0, 0, 0, 0, 1))
            self.set_timesteps(control_timestep=0.02, physics_timestep=0.002)
            pole = world.add("body", pos=(0, 0, 0.5))
            hinge = pole.add("joint", type="hinge", axis=(0, 1, 0))
            self.box = pole.add("geom", type="box", size=(0.1, 0.1, 0.3))
            actuator = self.root_entity.mjcf_model.actuator
            for gear in (1, 2):
                actuator.add("motor", joint=hinge, gear=(gear, *[0] * 5))

        root_entity = None

        def initialize_episode_mjcf(self, random_state):
            self.box.size = random_state.uniform(0.1, 0.5, 3)

        def get_reward(self, physics):
            return 1.0

    return composer.Environment(Growing(), time_limit=0.08, random_state=3)
