# SPDX-License-Identifier: Apache-2.0
"""Words that name nobody, although somebody may be called so.

Accounts and machines that thousands have, names of everybody's packages, the words of
simulations and of the files here.
"""

from __future__ import annotations

_WORDS = """
    acrobot actions actuator actuatorgroup admin administrator adroit agent also
    also_named analysis anonymous ant architecture arm armature asset author authors
    automation azimuth backend backup ball base bash batch bench bin bit_generator
    black block blue body box branch bring broken brown browser build builder
    bvh_depth bytes camera camera_name cameras capsule cart checker checkers cheetah
    chief circleci class client cloud cluster cmdline code codec colab command
    commit compiler complete compute computer conda contact container content
    content_type contributor contributors control core count cpu cpu_flags cube
    custom cylinder daemon damping data debian decoded deepmind default depth
    desktop dev developer developers device directory dirty distance dm-control
    dm_control docker dog door double drawer ec2-user egg elevation ellipsoid
    encoder encoder_version end_time engine env env_id env_info environment episode
    episode_id equality experiment export farama farama-foundation fault faults
    fedora fetch ffmpeg field file file_sha256 finger first fish fixedcamid flags
    flex floor foot format format_version frame frame_count frame_steps framework
    franka freejoint fresh friction games generator geom geoms git github gitlab
    gl_renderer goal gold google google-deepmind google-research gpu gradient gray
    green grey group guest gym gym_version gymnasium gymnasium-robotics half hammer
    hand head headnode height hinge home hopper host house http humanoid image
    imageio index inertial infix info initial institute inverted item jobs joint
    jointgroup jovyan jupyter kaggle kept kernel keyframe kitchen kwargs lab label
    laboratory labs lane laptop large layer leg length lengths libc library light
    linux linuxbrew little local localhost login long lookat machine mail main
    maintainer maintainers manager manifest manipulator march mark master material
    maze mesh meta mjrec modal mode model monitor motor mujoco name named network
    newton next nobody node none notebook null number numeric numpy observation
    office openai openaigym operator option options oracle orthographic other
    packages padded page parallel park path pen pending pendulum people person
    physics pick pictures pink pixel place plane play playback player plot point
    pole policy pool power previous price print private process project public push
    pusher python quadruped quality queue random random_state rate ray reach reacher
    reader reason record recorded recorder recording red refusal release relocate
    remote render render_mode rendered renderer replay report research reset reward
    rewards robot robotics root run runner runtime sample sandbox scene schedule
    school science script seal seed self sensor server service session sha256 shadow
    shared shell shin ship short silver sim simulation simulator site skybox slave
    slide slider small software source space spark speed sphere spot stacker staff
    stage staging standard start state statistics stats step steps stiffness store
    stride student study surroundings swimmer sync system target task team temp
    tendon terminal terminated test tester text texture thigh time timestamp
    timestamps timestep tmp tools torch torso tower trace track train trainer
    training trajectory trial truncated tunables tuple type types ubuntu uint32
    uinteger university unix unknown usable user username users vagrant value var
    variables vendor version versions video videos view viewer virtual visual walker
    wall water web wheel white width window windows with work worker working
    workspace workstation world wrappers write writer xml_file zero
"""

ORDINARY_WORDS = frozenset(_WORDS.split())
