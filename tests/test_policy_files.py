# SPDX-License-Identifier: Apache-2.0
"""Test policies from files: model.zip, TorchScript, torch.export and ONNX."""

import json
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

import mjrec
from mjrec.commands import main
from mjrec.environments.episode_seeds import EpisodeSeeds
from mjrec.environments.policies import load_policy, policy_file

SEEDS = EpisodeSeeds(environment=1, actions=2, policy=3)

# Torch warns that its older formats are deprecated.
pytestmark = [
    pytest.mark.filterwarnings("ignore:.*torch:DeprecationWarning"),
    pytest.mark.filterwarnings("ignore:.*torch.jit:FutureWarning"),
]


@pytest.mark.parametrize(
    ("name", "library", "extra"),
    [
        ("a.zip", "stable_baselines3", "stable-baselines3"),
        ("a.pt", "torch", "torch"),
        ("a.onnx", "onnxruntime", "onnx"),
    ],
)
def test_missing_library_names_the_extra(name, library, extra, tmp_path, monkeypatch):
    for module in [m for m in sys.modules if m.partition(".")[0] == library]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, library, None)
    (tmp_path / name).touch()
    env = gymnasium.make("InvertedPendulum-v5")
    advice = rf'pip install "mjrec\[{extra}\]"'
    with pytest.raises(mjrec.MissingDependency, match=advice):
        load_policy(str(tmp_path / name), env)


@pytest.mark.stable_baselines3
@pytest.mark.parametrize(
    ("algorithm", "env_id", "options"),
    [
        ("PPO", "InvertedPendulum-v5", {"use_sde": True, "n_steps": 64}),
        ("SAC", "InvertedPendulum-v5", {}),
        ("DQN", "CartPole-v1", {}),
    ],
)
def test_saved_model_acts_deterministically(algorithm, env_id, options, tmp_path):
    stable_baselines3 = pytest.importorskip("stable_baselines3")
    env = gymnasium.make(env_id)
    small = {"seed": 0, "device": "cpu", "policy_kwargs": {"net_arch": [8]}}
    model = getattr(stable_baselines3, algorithm)("MlpPolicy", env, **small, **options)
    path = tmp_path / "model.zip"
    model.save(path)
    policy = load_policy(str(path), env)
    assert policy_file(str(path)) == path
    for seed in range(5):
        observation, _ = env.reset(seed=seed)
        policy.reset(SEEDS)
        for each in (observation * 50, observation):
            expected, _ = model.predict(each, deterministic=True)
            assert np.array_equal(policy(each), expected)
    with pytest.raises(mjrec.PolicyError, match="unexpected keyword argument 'speed'"):
        load_policy(str(path), env, {"speed": 2})


@pytest.mark.stable_baselines3
def test_files_without_a_network_are_refused(tmp_path):
    torch = pytest.importorskip("torch")
    env = gymnasium.make("InvertedPendulum-v5")
    torch.save(torch.nn.Linear(4, 1).state_dict(), tmp_path / "weights.pt")
    with pytest.raises(mjrec.PolicyError, match=r"not contain a network.*torch\.jit"):
        load_policy(str(tmp_path / "weights.pt"), env)
    (tmp_path / "other.zip").write_bytes(b"PK\x05\x06" + bytes(18))
    with pytest.raises(mjrec.PolicyError, match=r"other\.zip"):
        load_policy(str(tmp_path / "other.zip"), env)


WEIGHTS = np.array([[2.0, 4.0]] * 3, np.float32)


def export_network(directory, kind):
    """Write a network that returns twice and four times the sum of an observation."""
    path = directory / f"network.{kind}"
    if kind == "onnx":
        pytest.importorskip("onnxruntime")
        onnx = pytest.importorskip("onnx")
        helper, single = onnx.helper, onnx.TensorProto.FLOAT
        graph = helper.make_graph(
            [helper.make_node("MatMul", ["observed", "weights"], ["action"])],
            "network",
            [helper.make_tensor_value_info("observed", single, [1, 3])],
            [helper.make_tensor_value_info("action", single, [1, 2])],
            [onnx.numpy_helper.from_array(WEIGHTS, "weights")],
        )
        opset = [helper.make_opsetid("", 17)]
        onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=8), path)
        return path
    torch = pytest.importorskip("torch")
    network, observed = torch.nn.Linear(3, 2, bias=False), torch.zeros(1, 3)
    with torch.no_grad():
        network.weight[:] = torch.from_numpy(WEIGHTS.T)
    if kind == "pt2":
        torch.export.save(torch.export.export(network, (observed,)), path)
    else:
        torch.jit.trace(network, observed).save(str(path))
    return path


@pytest.mark.stable_baselines3
@pytest.mark.parametrize("kind", ["pt", "pt2", "onnx"])
def test_network_gets_float32_rows(kind, tmp_path):
    """Actions that the network returns are clipped to their bounds."""
    env = type("Env", (), {"action_space": spaces.Box(-1, 1, (2,), np.float32)})
    policy = load_policy(str(export_network(tmp_path, kind)), env)
    policy.reset(SEEDS)
    assert policy(np.array([0.1, 0.2, -0.1])).tolist() == pytest.approx([0.4, 0.8])
    parts = {"pose": np.array([[0.1], [0.2]]), "speed": -0.1}
    assert policy(parts).tolist() == pytest.approx([0.4, 0.8])
    assert policy(np.array([1, 2, 3])).tolist() == [1, 1]


@pytest.mark.stable_baselines3
def test_command_records_a_network_by_file_name(tmp_path, monkeypatch, capsys):
    torch = pytest.importorskip("torch")
    monkeypatch.chdir(tmp_path)
    torch.jit.trace(torch.nn.Linear(4, 1), torch.zeros(1, 4)).save("net.pt")
    arguments = ["--policy", "net.pt", "--policy-kwargs", '{"device": "cpu"}', "--json"]
    arguments += ["--render", "off", "--out", "out", "--max-steps", "3"]
    assert main(["record", "InvertedPendulum-v5", *arguments]) == 0
    assert json.loads(capsys.readouterr().out)["episodes"][0]["length"] == 3
